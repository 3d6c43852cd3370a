# metro.h: everything is built with cc and make.
#
#   make            the examples, into build/
#   make paper      every figure, chart and table of the paper, into out/ (QUICK=1: a small version, in a minute)
#   make test       the tests; ends with one line "N passed, N failed"
#   make docs       the book, into out/book/, with the checks of its prose
#   make check      the tests again under every compiler, sanitizer, emulator and fuzzer that is installed
#   make bench      speed, as ratios and times
#   make calibrate  long statistical studies of the stated errors
#   make references remakes the committed figures
#   make install    copies metro.h to $(DESTDIR)$(PREFIX)/include

CC ?= cc
CFLAGS ?= -O2
PREFIX ?= /usr/local
LDLIBS = -lm
WARNINGS = -std=c99 -Wall -Wextra -pedantic

CORES := $(shell getconf _NPROCESSORS_ONLN 2>/dev/null || echo 1)
MAKEFLAGS += -j$(CORES) --no-print-directory

EXAMPLES := $(patsubst examples/%.c,build/%,$(sort $(wildcard examples/*.c)))
TESTS := $(patsubst tests/%.c,build/%,$(sort $(wildcard tests/test_*.c)))
TEST_LOGS := $(TESTS:=.log)

.PHONY: all paper test docs check bench calibrate references install uninstall clean always
all: $(EXAMPLES) build/weave

# What names no scene needs no ray tracer, and compiles in a third of the time without.
PLAIN := $(basename $(notdir $(shell grep -L metro_scene examples/*.c tests/*.c)))
OPTIONS = $(if $(filter $(notdir $@),$(PLAIN)),-DMETRO_NO_TRACER)

build out:
	@mkdir -p $@

build/test_%: tests/test_%.c $(wildcard tests/*.h) metro.h examples/plot.h | build
	$(CC) $(WARNINGS) $(CFLAGS) $(OPTIONS) -o $@ $< $(LDLIBS)

build/bench_%: tests/bench_%.c metro.h | build
	$(CC) $(WARNINGS) $(CFLAGS) $(OPTIONS) -o $@ $< $(LDLIBS)

build/calibrate_%: tests/calibrate_%.c $(wildcard tests/*.h) metro.h | build
	$(CC) $(WARNINGS) $(CFLAGS) $(OPTIONS) -o $@ $< $(LDLIBS)

build/weave: docs/weave.c | build
	$(CC) $(WARNINGS) $(CFLAGS) -o $@ $<

build/%: examples/%.c $(wildcard examples/*.h) metro.h | build
	$(CC) $(WARNINGS) $(CFLAGS) $(OPTIONS) -o $@ $< $(LDLIBS)

# Each test runs to its end and leaves a log; the sum over the logs is the last line, and decides.
%.log: % always
	@$< > $@ 2>&1 || true

test: $(TEST_LOGS) build/test_weave.log build/test_render.log
	@sh tests/summary.sh $^

build/test_weave.log: build/weave tests/test_weave.sh always
	@sh tests/test_weave.sh build/weave > $@ 2>&1 || true

build/test_render.log: build/render build/merge tests/test_render.sh always
	@sh tests/test_render.sh build/render build/merge > $@ 2>&1 || true

paper: $(EXAMPLES) build/weave | out
	@sh examples/paper.sh
	@sh docs/book.sh

docs: build/weave
	@sh docs/book.sh --check

check: $(TESTS) build/weave docs
	@CC="$(CC)" sh tests/matrix.sh

bench: build/bench_laboratory build/bench_light build/bench_bundles
	@build/bench_laboratory
	@sh tests/bench_compile.sh
	@sh tests/bench_bvh.sh
	@build/bench_light
	@build/bench_bundles

calibrate: build/calibrate_laboratory build/calibrate_light
	@build/calibrate_laboratory
	@build/calibrate_light

references: build/fig2 build/fig5
	@build/fig2
	@build/fig5
	@mkdir -p docs/figures
	cp out/fig2.svg out/fig5.svg docs/figures/

install:
	install -d $(DESTDIR)$(PREFIX)/include
	install -m 644 metro.h $(DESTDIR)$(PREFIX)/include/metro.h

uninstall:
	rm -f $(DESTDIR)$(PREFIX)/include/metro.h

clean:
	rm -rf build out
