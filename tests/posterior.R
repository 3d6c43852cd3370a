# Makes tests/data/posterior*.csv: chains, and what the R package posterior (Vehtari et al. 2021) says of them.
# Debian: apt install r-cran-posterior. Run from the top of the project: Rscript tests/posterior.R
# The committed files come from posterior 1.4.0 under R 4.2.2.

suppressMessages(library(posterior))
options(warn = -1)  # posterior warns where it caps an ESS
RNGkind("Mersenne-Twister", "Inversion", "Rejection")
set.seed(20260)

# Draws are rounded to few digits; the answers belong to the draws as they stand in the file.
ar1 <- function(draws, chains, rho) {
  x <- matrix(0, draws, chains)
  for (c in 1:chains) {
    x[1, c] <- rnorm(1)
    for (i in seq_len(draws)[-1]) x[i, c] <- rho * x[i - 1, c] + sqrt(1 - rho^2) * rnorm(1)
  }
  round(x, 3)
}
normal <- function(draws, chains) round(matrix(rnorm(draws * chains), draws, chains), 3)
stuck <- function(draws, at) matrix(rep(at, each = draws), draws, length(at))

cases <- list(
  ar1_slow        = ar1(500, 4, .9),
  white_noise     = normal(120, 4),
  ar1_antithetic  = ar1(250, 4, -.9),
  one_chain       = ar1(300, 1, .5),
  odd_number      = ar1(151, 3, .6),
  discrete        = matrix(rbinom(400, 4, .5), 100, 4),
  cauchy          = signif(matrix(rcauchy(400), 100, 4), 4),
  trending        = normal(100, 4) + round((1:100) / 40, 3),
  one_chain_off   = normal(100, 4) + rep(c(0, 0, 0, 2), each = 100),
  one_chain_wide  = normal(100, 4) * rep(c(1, 1, 1, 5), each = 100),
  offset          = normal(100, 2) + 1e8,
  one_stands      = cbind(normal(60, 3), 1),
  coin            = matrix(rep(c(0, 1, 1, 0), 20), 40, 2),
  constant        = stuck(20, c(3, 3)),
  stuck_at_two    = stuck(20, c(0, 1)),
  stuck_at_four   = stuck(100, c(.1, .2, .3, .4)),
  draws_1 = normal(1, 4), draws_2 = normal(2, 4), draws_3 = normal(3, 4), draws_4 = normal(4, 4),
  draws_5 = normal(5, 4), draws_6 = normal(6, 4), draws_7 = normal(7, 4), draws_8 = normal(8, 4)
)

number <- function(x) ifelse(is.na(x), "nan", ifelse(is.infinite(x), "inf", sprintf("%.17g", x)))
answers <- function(x) {
  number(c(rhat(x), ess_bulk(x), ess_tail(x), ess_mean(x), mcse_mean(x), mcse_sd(x)))
}
row <- function(file, ...) cat(paste(c(...), collapse = ","), "\n", sep = "", file = file)
plain <- function(x) format(x, digits = 15, trim = TRUE, scientific = FALSE, drop0trailing = TRUE)

chains_csv <- file("tests/data/posterior_chains.csv", "w")
answers_csv <- file("tests/data/posterior.csv", "w")
rho_csv <- file("tests/data/posterior_autocorrelation.csv", "w")
writeLines("# case, chain, up to 50 draws; rows of a chain follow each other", chains_csv)
writeLines("# case, chains, draws, rhat, ess_bulk, ess_tail, ess_mean, mcse_mean, mcse_sd", answers_csv)
writeLines("# case, autocorrelation of its first chain at lags 0 .. 9", rho_csv)
for (name in names(cases)) {
  x <- cases[[name]]
  text <- matrix(vapply(x, plain, ""), nrow(x), ncol(x))
  x <- matrix(as.numeric(text), nrow(x), ncol(x))
  for (c in seq_len(ncol(x)))
    for (first in seq(1, nrow(x), 50)) row(chains_csv, name, c - 1, text[first:min(nrow(x), first + 49), c])
  row(answers_csv, name, ncol(x), nrow(x), answers(x))
  if (nrow(x) >= 100 && !grepl("stuck", name)) row(rho_csv, name, number(autocorrelation(x[, 1])[1:10]))
}
close(chains_csv)
close(answers_csv)
close(rho_csv)

# Many short chains with many ties, where every branch of the estimators is taken.
small_csv <- file("tests/data/posterior_small.csv", "w")
writeLines("# chains, draws, rhat, ess_bulk, ess_tail, ess_mean, mcse_mean, mcse_sd, the draws", small_csv)
for (k in 1:120) {
  chains <- sample(1:4, 1)
  draws <- sample(4:floor(50 / chains), 1)
  x <- switch(k %% 4 + 1,
              matrix(sample(0:3, draws * chains, TRUE), draws, chains),
              round(10 * ar1(draws, chains, .7)),
              round(10 * ar1(draws, chains, -.8)),
              round(5 * normal(draws, chains)) + rep(sample(0:8, chains, TRUE), each = draws))
  row(small_csv, chains, draws, answers(x), plain(as.vector(x)))
}
close(small_csv)
