/* weave.c - metro.h as a book.

       cc -O2 -o build/weave docs/weave.c
       build/weave metro.h out out/book --tests tests --lectures docs --check
       build/weave metro.h --extract build/docs --lectures docs

   The first form writes out/book/index.html, one file that needs no network, and one page for each lecture
   docs/NAME.md; figures and measured values come from the folder `out`, and where no run has made them yet a
   placeholder stands. The second form writes each complete program that stands in the prose to example_N.c, for the
   build to compile and run. Messages read file:line: text. With --check the whole is checked and each message makes
   the exit status 1; without, only a file that cannot be read or written does. 2 is bad usage.

   metro.h is cut at its column-0 block comments: they are prose, everything else is listing. Prose is read twice by
   the same code. The first reading collects headings, equations and citations and throws its pages away; the second
   writes, with every link known. The order of the program is text, files, the cut, C, symbols, formulas, listings,
   results, prose, pages, checks. Nothing depends on the date, the place or the order of a folder, so that two runs
   give the same bytes. */

#define _POSIX_C_SOURCE 200809L
#include <dirent.h>
#include <errno.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>

enum {
    COLUMNS = 118,        /* the longest line of metro.h */
    PAPER_EQUATIONS = 19, /* the paper numbers its equations (1) to (19); each stands in the table of appendix A */
    PROSE_INDENT = 3,     /* the width of the comment's opening, which all prose is indented by */
    BLOCK_INDENT = 4,     /* equations and verbatim blocks are indented by as much again */
    FORMULA_DEPTH = 24,   /* nesting of a formula */
    FIELDS = 64           /* columns of a CSV file */
};

/* ---- Text: a span points into bytes that somebody else keeps; a text owns its bytes and grows. ---- */

typedef struct {
    const char *at;
    size_t size;
} span;

typedef struct {
    char *data;
    size_t size, room;
} text;

static void *memory_grow(void *old, size_t bytes)
{
    void *memory = realloc(old, bytes);
    if (memory == NULL) {
        fprintf(stderr, "weave: out of memory\n");
        exit(2);
    }
    return memory;
}

/* Room for one more item in an array that holds `count`: it doubles whenever `count` is a power of two. */
static void *array_grow(void *items, size_t count, size_t item_size)
{
    if (count != 0 && (count & (count - 1)) != 0) return items;
    return memory_grow(items, (count == 0 ? 1 : 2 * count) * item_size);
}

static void text_put_bytes(text *out, const char *bytes, size_t size)
{
    if (size == 0) return;
    if (out->room - out->size <= size) {
        out->room = 2 * (out->size + size) + 64;
        out->data = (char *)memory_grow(out->data, out->room);
    }
    memcpy(out->data + out->size, bytes, size);
    out->size += size;
    out->data[out->size] = 0;
}

static void text_put(text *out, const char *words) { text_put_bytes(out, words, strlen(words)); }

static void text_put_span(text *out, span s) { text_put_bytes(out, s.at, s.size); }

static void text_format(text *out, const char *format, ...)
{
    char piece[256], *large = NULL;
    va_list arguments;
    int size;
    va_start(arguments, format);
    size = vsnprintf(piece, sizeof piece, format, arguments);
    va_end(arguments);
    if (size >= (int)sizeof piece) {
        large = (char *)memory_grow(NULL, (size_t)size + 1);
        va_start(arguments, format);
        vsnprintf(large, (size_t)size + 1, format, arguments);
        va_end(arguments);
    }
    text_put(out, large != NULL ? large : piece);
    free(large);
}

/* The bytes as HTML shows them. */
static void text_escape(text *out, span s)
{
    size_t i;
    for (i = 0; i < s.size; i++) {
        if (s.at[i] == '&') text_put(out, "&amp;");
        else if (s.at[i] == '<') text_put(out, "&lt;");
        else if (s.at[i] == '>') text_put(out, "&gt;");
        else if (s.at[i] == '"') text_put(out, "&quot;");
        else text_put_bytes(out, s.at + i, 1);
    }
}

static void text_free(text *t)
{
    text nothing = { NULL, 0, 0 };
    free(t->data);
    *t = nothing;
}

static span span_make(const char *at, size_t size)
{
    span s;
    s.at = at;
    s.size = size;
    return s;
}

static span span_of(const char *words) { return span_make(words, strlen(words)); }

static span span_of_text(const text *t) { return span_make(t->size > 0 ? t->data : "", t->size); }

static span span_from(span s, size_t from)
{
    return from >= s.size ? span_make("", 0) : span_make(s.at + from, s.size - from);
}

static span span_part(span s, size_t from, size_t size)
{
    s = span_from(s, from);
    return span_make(s.at, size < s.size ? size : s.size);
}

static int span_equal(span a, span b) { return a.size == b.size && (a.size == 0 || memcmp(a.at, b.at, a.size) == 0); }

static int span_is(span s, const char *words) { return span_equal(s, span_of(words)); }

static int span_starts(span s, const char *words)
{
    return s.size >= strlen(words) && memcmp(s.at, words, strlen(words)) == 0;
}

/* Where `words` begins in s, or s.size. */
static size_t span_find(span s, const char *words)
{
    size_t i;
    for (i = 0; i < s.size; i++)
        if (span_starts(span_from(s, i), words)) return i;
    return s.size;
}

/* The character at i; 0 behind the end. */
static char span_at(span s, size_t i) { return (char)(i < s.size ? s.at[i] : 0); }

static int is_digit(char c) { return c >= '0' && c <= '9'; }
static int is_upper(char c) { return c >= 'A' && c <= 'Z'; }
static int is_lower(char c) { return c >= 'a' && c <= 'z'; }
static int is_letter(char c) { return is_upper(c) || is_lower(c); }
static int is_word(char c) { return is_letter(c) || is_digit(c) || c == '_'; }
static int is_blank(char c) { return c == ' ' || c == '\t' || c == '\r' || c == '\n'; }

static span span_trim(span s)
{
    while (s.size > 0 && is_blank(s.at[s.size - 1])) s.size--;
    while (s.size > 0 && is_blank(s.at[0])) s = span_from(s, 1);
    return s;
}

static size_t span_indent(span s)
{
    size_t i = 0;
    while (span_at(s, i) == ' ') i++;
    return i;
}

/* The length of the word (letters, digits, underscores) at i. */
static size_t span_word(span s, size_t i)
{
    size_t n = 0;
    while (is_word(span_at(s, i + n))) n++;
    return n;
}

/* The value of the digits at i and how many they are, at most 4. */
static size_t span_digits(span s, size_t i, size_t *value)
{
    size_t n = 0;
    *value = 0;
    while (n < 4 && is_digit(span_at(s, i + n))) *value = 10 * *value + (size_t)(s.at[i + n++] - '0');
    return n;
}

/* Whether the word stands in s, not as a part of a longer one. */
static int span_has_word(span s, span word)
{
    size_t i = 0;
    while (i < s.size) {
        size_t n = span_word(s, i);
        if (n == word.size && memcmp(s.at + i, word.at, n) == 0) return 1;
        i += n > 0 ? n : 1;
    }
    return 0;
}

/* A NUL-terminated copy, cut to fit. */
static const char *span_copy(span s, char *copy, size_t room)
{
    size_t n = s.size < room - 1 ? s.size : room - 1;
    memcpy(copy, s.at, n);
    copy[n] = 0;
    return copy;
}

/* Takes the next piece of *rest up to `separator`; 0 when nothing is left. */
static int span_split(span *rest, char separator, span *piece)
{
    size_t n = 0;
    if (rest->at == NULL) return 0;
    while (n < rest->size && rest->at[n] != separator) n++;
    *piece = span_part(*rest, 0, n);
    *rest = n < rest->size ? span_from(*rest, n + 1) : span_make(NULL, 0);
    return 1;
}

/* The length of a number of a heading or an equation at i: 5, 5.2, 5.2.1, R5, A, A.1. */
static size_t span_number(span s, size_t i)
{
    size_t n = is_upper(span_at(s, i)) ? 1 : 0;
    while (is_digit(span_at(s, i + n))) n++;
    while (n > 0 && span_at(s, i + n) == '.' && is_digit(span_at(s, i + n + 1))) {
        n += 2;
        while (is_digit(span_at(s, i + n))) n++;
    }
    return is_word(span_at(s, i + n)) ? 0 : n;
}

/* ---- Files and what is known about them. ---- */

typedef struct {
    char *path;
    text bytes;
    span *line; /* line[0] is line 1, without its end */
    size_t lines;
} source;

typedef struct {
    span number, title; /* the number is empty where the heading has none */
    size_t line, level; /* level 1 is the title of a page, 2 a chapter, 3 a section */
} heading;

/* A page is what becomes one HTML file: the book or a lecture. */
typedef struct {
    source from;
    heading *headings;
    size_t heading_count;
    const char *home; /* what a link to a place in the book begins with */
    int lecture;
} page;

typedef struct {
    int prose;
    size_t first, last;
} block;

typedef enum { FUNCTION, TYPE, CONSTANT } symbol_kind;

typedef struct {
    span name;
    symbol_kind kind;
    size_t declared;            /* line of its name in the interface, or of its type; 0 without */
    size_t defined, from, last; /* a function: line of its name, first line with the comment right above, last line */
    int placed_declaration, placed_definition; /* the anchors have been written */
} symbol;

typedef struct {
    span tag;
    size_t line;
    text formula;
} equation;

typedef struct {
    char tag[16];
    size_t line;
} citation;

typedef struct {
    page book, *lectures, *writing;
    size_t lecture_count;
    const char *results, *out;
    int check;      /* the checks of the whole are asked for */
    int collecting; /* the first reading: nothing is complained about, nothing is kept of the output */
    int pulling;    /* a function that is pulled by name, from its place elsewhere */
    int failed;     /* a file could not be read or written */
    size_t mistakes, examples;
    const char *extract;
    size_t implementation; /* the line where the interface ends */
    block *blocks;
    size_t block_count;
    symbol *symbols;
    size_t symbol_count;
    equation *equations;
    size_t equation_count;
    citation *citations;
    size_t citation_count;
    size_t paper_line[PAPER_EQUATIONS + 1]; /* where paper (N) is mapped */
} weave;

static void complain(weave *w, size_t line, const char *format, ...)
{
    va_list arguments;
    if (w->collecting || w->pulling) return;
    fprintf(stderr, "%s:%lu: ", w->writing->from.path, (unsigned long)line);
    va_start(arguments, format);
    vfprintf(stderr, format, arguments);
    va_end(arguments);
    fprintf(stderr, "\n");
    w->mistakes++;
}

/* Whether what is written stands in its own place: there it is what links go to. */
static int at_home(const weave *w) { return !w->pulling && !w->writing->lecture; }

static int file_read(const char *path, text *bytes)
{
    char piece[16384];
    size_t n;
    FILE *file = fopen(path, "rb");
    if (file == NULL) return 0;
    while ((n = fread(piece, 1, sizeof piece, file)) > 0) text_put_bytes(bytes, piece, n);
    n = ferror(file) ? 0 : 1;
    fclose(file);
    return n != 0;
}

/* Makes the folders on the way to `path`. */
static void folder_make(const char *path)
{
    char part[1024];
    size_t i;
    for (i = 0; path[i] != 0 && i < sizeof part - 1; i++) {
        part[i] = path[i];
        part[i + 1] = 0;
        if (path[i + 1] == '/' || path[i + 1] == 0) mkdir(part, 0777);
    }
}

static int file_write(weave *w, const char *folder, const char *name, const text *bytes)
{
    char path[1024];
    FILE *file;
    int good;
    snprintf(path, sizeof path, "%s/%s", folder, name);
    folder_make(folder);
    file = fopen(path, "wb");
    good = file != NULL && fwrite(bytes->data, 1, bytes->size, file) == bytes->size;
    if (file != NULL && fclose(file) != 0) good = 0;
    if (good) return 1;
    fprintf(stderr, "%s: cannot be written: %s\n", path, strerror(errno));
    w->failed = 1;
    return 0;
}

static int name_compare(const void *a, const void *b) { return strcmp(*(char *const *)a, *(char *const *)b); }

/* The files of a folder whose names end in `suffix`, as paths in the order of their names. */
static char **folder_list(const char *folder, const char *suffix, size_t *count)
{
    char **names = NULL;
    struct dirent *entry;
    DIR *directory = opendir(folder);
    *count = 0;
    while (directory != NULL && (entry = readdir(directory)) != NULL) {
        size_t size = strlen(entry->d_name), tail = strlen(suffix), room = strlen(folder) + size + 2;
        if (size <= tail || strcmp(entry->d_name + size - tail, suffix) != 0) continue;
        names = (char **)array_grow(names, *count, sizeof *names);
        names[*count] = (char *)memory_grow(NULL, room);
        snprintf(names[(*count)++], room, "%s/%s", folder, entry->d_name);
    }
    if (directory != NULL) closedir(directory);
    if (*count > 0) qsort(names, *count, sizeof *names, name_compare);
    return names;
}

static void source_cut(source *s)
{
    size_t from = 0, i;
    for (i = 0; i < s->bytes.size; i++) {
        if (s->bytes.data[i] != '\n') continue;
        s->line = (span *)array_grow(s->line, s->lines, sizeof *s->line);
        s->line[s->lines++] = span_make(s->bytes.data + from, i - from);
        from = i + 1;
    }
}

/* Complains of what no line may hold, and makes it harmless. */
static void source_check_line(weave *w, source *s, size_t number)
{
    span line = s->line[number - 1];
    char *bytes = s->bytes.data + (line.at - s->bytes.data);
    size_t i, strange = 0, indent = 0;
    for (i = 0; i < line.size; i++) {
        if (bytes[i] >= ' ' && bytes[i] <= '~') continue;
        if (strange++ == 0 && w->check)
            complain(w, number, "column %lu holds the byte 0x%02x, which is not printable ASCII",
                     (unsigned long)i + 1, (unsigned)(unsigned char)bytes[i]);
        bytes[i] = bytes[i] == '\t' || bytes[i] == '\r' ? ' ' : '?';
    }
    if (!w->check || w->writing->lecture) return;
    while (indent < line.size && line.at[indent] == ' ') indent++;
    if (line.size > COLUMNS && line.at[indent] != '|') /* a row of a table is one line, however long */
        complain(w, number, "the line has %lu columns, over %d", (unsigned long)line.size, COLUMNS);
    if (line.size > 0 && line.at[line.size - 1] == ' ') complain(w, number, "the line ends in a blank");
}

static int page_read(weave *w, page *p, const char *path)
{
    source *s = &p->from;
    size_t i;
    s->path = (char *)memory_grow(NULL, strlen(path) + 1);
    strcpy(s->path, path);
    w->writing = p;
    if (!file_read(path, &s->bytes)) {
        fprintf(stderr, "%s: cannot be read: %s\n", path, strerror(errno));
        w->failed = 1;
        return 0;
    }
    if (s->bytes.size > 0 && s->bytes.data[s->bytes.size - 1] != '\n') text_put(&s->bytes, "\n");
    source_cut(s);
    for (i = 1; i <= s->lines; i++) source_check_line(w, s, i);
    return 1;
}

/* Lines first to last as they stand, counted from 1. */
static span source_lines(const source *s, size_t first, size_t last)
{
    if (first < 1 || last > s->lines || first > last) return span_make("", 0);
    return span_make(s->line[first - 1].at,
                     (size_t)(s->line[last - 1].at - s->line[first - 1].at) + s->line[last - 1].size);
}

/* ---- The cut: column-0 block comments that have their lines to themselves are prose. ---- */

/* The line where the comment that opens line `first` closes, 0 if none does; *alone: no code follows it there. */
static size_t comment_end(const source *s, size_t first, int *alone)
{
    size_t i;
    for (i = first; i <= s->lines; i++) {
        span line = i == first ? span_from(s->line[i - 1], 2) : s->line[i - 1];
        size_t close = span_find(line, "*/");
        if (close == line.size) continue;
        *alone = span_trim(span_from(line, close + 2)).size == 0;
        return i;
    }
    return 0;
}

static void block_add(weave *w, int prose, size_t first, size_t last)
{
    block *before = w->block_count > 0 ? &w->blocks[w->block_count - 1] : NULL;
    if (!prose && before != NULL && !before->prose) {
        before->last = last;
        return;
    }
    w->blocks = (block *)array_grow(w->blocks, w->block_count, sizeof *w->blocks);
    w->blocks[w->block_count].prose = prose;
    w->blocks[w->block_count].first = first;
    w->blocks[w->block_count++].last = last;
}

static void blocks_cut(weave *w)
{
    const source *s = &w->book.from;
    size_t i, last;
    w->implementation = s->lines + 1;
    for (i = 1; i <= s->lines; i = last + 1) {
        span line = s->line[i - 1];
        int alone = 0;
        last = i;
        if (span_starts(line, "/*")) {
            last = comment_end(s, i, &alone);
            if (last == 0) complain(w, i, "the comment is never closed");
            if (last == 0) last = s->lines;
        } else if (span_starts(line, "#if") && span_find(line, "METRO_IMPLEMENTATION") < line.size &&
                   w->implementation > s->lines)
            w->implementation = i;
        block_add(w, alone, i, last);
    }
}

/* The block of prose that ends right above `line`, or NULL. */
static const block *block_above(const weave *w, size_t line)
{
    size_t i;
    for (i = 0; i < w->block_count; i++)
        if (w->blocks[i].prose && w->blocks[i].last + 1 == line) return &w->blocks[i];
    return NULL;
}

/* ---- C: enough of its lexical grammar to colour a listing and to find what it declares. ---- */

typedef enum { BLANK, COMMENT, STRING, NUMBER, WORD, OTHER } token_kind;

static size_t token_quoted(span s, size_t i)
{
    size_t n = 1;
    while (i + n < s.size && s.at[i + n] != s.at[i] && s.at[i + n] != '\n')
        n += s.at[i + n] == '\\' && i + n + 1 < s.size && s.at[i + n + 1] != '\n' ? 2 : 1;
    return i + n < s.size && s.at[i + n] == s.at[i] ? n + 1 : n;
}

static size_t token_number(span s, size_t i)
{
    size_t n = 1;
    for (;; n++) {
        char c = span_at(s, i + n), before = span_at(s, i + n - 1);
        int sign = (c == '+' || c == '-') && (before == 'e' || before == 'E' || before == 'p' || before == 'P');
        if (!is_word(c) && c != '.' && !sign) return n;
    }
}

/* The length of the token at i, at least 1. */
static size_t token_read(span s, size_t i, token_kind *kind)
{
    char c = s.at[i];
    size_t n;
    *kind = OTHER;
    if (is_blank(c)) {
        *kind = BLANK;
        return 1;
    }
    if (c == '/' && span_at(s, i + 1) == '*') {
        *kind = COMMENT;
        n = span_find(span_from(s, i + 2), "*/") + 4;
        return i + n <= s.size ? n : s.size - i;
    }
    if (c == '"' || c == '\'') {
        *kind = STRING;
        return token_quoted(s, i);
    }
    if (is_digit(c) || (c == '.' && is_digit(span_at(s, i + 1)))) {
        *kind = NUMBER;
        return token_number(s, i);
    }
    n = span_word(s, i);
    if (n > 0) *kind = WORD;
    return n > 0 ? n : 1;
}

static int word_is_keyword(span word)
{
    static const char *const keywords[] = {
        "auto",   "break",    "case",     "char",     "const",   "continue", "default", "do",     "double",
        "else",   "enum",     "extern",   "float",    "for",     "goto",     "if",      "inline", "int",
        "long",   "register", "restrict", "return",   "short",   "signed",   "sizeof",  "static", "struct",
        "switch", "typedef",  "union",    "unsigned", "void",    "volatile", "while",   "define", "elif",
        "endif",  "error",    "ifdef",    "ifndef",   "include", "pragma",   "undef"
    };
    size_t i;
    for (i = 0; i < sizeof keywords / sizeof *keywords; i++)
        if (span_is(word, keywords[i])) return 1;
    return 0;
}

/* ---- Symbols: what metro.h declares and defines. ---- */

static symbol *symbol_find(const weave *w, span name)
{
    size_t i;
    for (i = 0; i < w->symbol_count; i++)
        if (span_equal(w->symbols[i].name, name)) return &w->symbols[i];
    return NULL;
}

static symbol *symbol_add(weave *w, span name, symbol_kind kind)
{
    static const symbol nothing;
    symbol *s = symbol_find(w, name);
    if (s != NULL) return s;
    w->symbols = (symbol *)array_grow(w->symbols, w->symbol_count, sizeof *w->symbols);
    s = &w->symbols[w->symbol_count++];
    *s = nothing;
    s->name = name;
    s->kind = kind;
    return s;
}

/* A declaration at column 0 while it is read. */
typedef struct {
    size_t first, line, depth, parens;
    span name, pointer, word; /* before the parameters, in a pointer to a function, the last one outside of braces */
    size_t name_line, word_line;
    char before, before_that; /* the two significant characters before the token */
    int api, type, enumeration, prepared;
} declaration;

static void declaration_word(weave *w, declaration *d, span word)
{
    symbol *s;
    if (d->depth == 0) {
        if (span_is(word, "METRO_API")) d->api = 1;
        if (span_is(word, "typedef")) d->type = 1;
        if (span_is(word, "enum")) d->enumeration = 1;
        if (d->type && d->before == '*' && d->before_that == '(' && d->pointer.size == 0) {
            d->pointer = word;
            d->name_line = d->line;
        }
        d->word = word;
        d->word_line = d->line;
    } else if (d->depth == 1 && d->type && d->enumeration && (d->before == '{' || d->before == ',')) {
        s = symbol_add(w, word, CONSTANT);
        if (s->declared == 0) s->declared = d->line;
    }
}

/* The closing brace of a body, or the semicolon of a prototype or a type. */
static void declaration_end(weave *w, const declaration *d, int body)
{
    const block *above = block_above(w, d->first);
    symbol *s;
    if (d->type) {
        s = symbol_add(w, d->pointer.size > 0 ? d->pointer : d->word, TYPE);
        if (s->declared == 0) s->declared = d->pointer.size > 0 ? d->name_line : d->word_line;
    } else if (body) {
        s = symbol_add(w, d->name, FUNCTION);
        if (s->defined != 0) return;
        s->defined = d->name_line;
        s->from = above != NULL ? above->first : d->first;
        s->last = d->line;
    } else if (d->api && d->name.size > 0 && d->line < w->implementation) {
        s = symbol_add(w, d->name, FUNCTION);
        if (s->declared == 0) s->declared = d->name_line;
    }
}

/* Follows braces and parentheses; returns 1 when the declaration has ended. */
static int declaration_sign(weave *w, declaration *d, char c, int first_column)
{
    int body = d->name.size > 0 && !d->type && !d->prepared;
    if (c == '{') {
        d->depth++;
        return d->before == '"'; /* extern "C" { */
    }
    if (c == '}') {
        d->depth = d->depth == 0 || first_column ? 0 : d->depth - 1;
        if (d->depth == 0 && body) declaration_end(w, d, 1);
        return d->depth == 0 && body;
    }
    if (d->depth > 0) return 0;
    if (c == '(' && d->parens++ == 0 && !span_starts(d->name, "metro")) { /* an attribute may stand before the name */
        d->name = d->word;
        d->name_line = d->word_line;
    }
    if (c == ')' && d->parens > 0) d->parens--;
    if (c == '=') d->prepared = 1;
    if (c == ';' && d->parens == 0) declaration_end(w, d, 0);
    return c == ';' && d->parens == 0;
}

/* Reads the declaration that begins in line `first`; returns its last line. */
static size_t declaration_read(weave *w, size_t first)
{
    span all = source_lines(&w->book.from, first, w->book.from.lines);
    declaration d;
    size_t i = 0, n;
    memset(&d, 0, sizeof d);
    d.first = d.line = first;
    for (; i < all.size; i += n) {
        token_kind kind;
        span token, rest;
        n = token_read(all, i, &kind);
        token = rest = span_part(all, i, n);
        if (kind == WORD) declaration_word(w, &d, token);
        if (kind == OTHER && declaration_sign(w, &d, token.at[0], i == 0 || all.at[i - 1] == '\n')) return d.line;
        if (kind != BLANK && kind != COMMENT) {
            d.before_that = d.before;
            d.before = token.at[0];
        }
        while (span_split(&rest, '\n', &token) && rest.at != NULL) d.line++;
    }
    return w->book.from.lines;
}

/* Declarations begin with a word in the first column of a listing; a METRO_ macro is a symbol, too. */
static void symbols_collect(weave *w)
{
    size_t b, i;
    for (b = 0; b < w->block_count; b++) {
        for (i = w->blocks[b].first; !w->blocks[b].prose && i <= w->blocks[b].last; i++) {
            span line = w->book.from.line[i - 1];
            if (is_letter(span_at(line, 0))) i = declaration_read(w, i);
            if (span_starts(line, "#define METRO_")) {
                symbol *s = symbol_add(w, span_part(line, 8, span_word(line, 8)), CONSTANT);
                if (s->declared == 0) s->declared = i;
            }
        }
    }
}

/* The function whose body, or whose comment right above, holds the line. */
static const symbol *symbol_around(const weave *w, size_t line)
{
    size_t i;
    for (i = 0; i < w->symbol_count; i++)
        if (w->symbols[i].defined > 0 && line >= w->symbols[i].from && line <= w->symbols[i].last)
            return &w->symbols[i];
    return NULL;
}

/* ---- Formulas: the linear form becomes presentation MathML (the Core subset).

   row    = { operator | atom [ _ script ] [ ^ script ] }
   atom   = number | name | "text" | ( row ) | [ row ] | { row }
          | frac{row}{row} | binom{row}{row} | sqrt{row} | abs(row)
   script = atom | sign | sign atom | *

   One letter is a variable, letters of the Greek alphabet go by name, a letter with digits (x0) carries them as its
   index, a star right behind a letter (P*) belongs to it, and any other word of three letters or more is set upright.
   Three blanks are a gap; a formula of several rows is aligned at the first relation of each. ---- */

typedef struct {
    span in;
    size_t at, depth;
    long open;          /* parentheses that this row leaves open: a formula may go on in the next row */
    int aligned, cells; /* rows of an aligned formula break into cells: before the first relation, and at wide gaps */
    int script;         /* inside a script, where letters that touch are several variables: c_{ab} */
    int operand;        /* the last thing was an operand, so a sign is a binary one */
    int tall;           /* something higher than a line: the parentheses around it grow */
    const char *problem;
    size_t problem_at;
} formula;

typedef struct {
    text body;
    char kind; /* 'a' ordinary, 'f' the name of a function, 't' a word of a sentence, 'l' limits go below and above */
} atom;

static void formula_row(formula *f, text *out, size_t end);

static void formula_fail(formula *f, const char *problem)
{
    if (f->problem == NULL) {
        f->problem = problem;
        f->problem_at = f->at;
    }
    f->at = f->in.size;
}

static size_t formula_gap(formula *f, size_t end)
{
    size_t gap = 0;
    while (f->at < end && is_blank(span_at(f->in, f->at))) f->at++, gap++;
    return gap;
}

/* The place of the closer that matches the opener at f->at, or f->in.size. */
static size_t formula_match(const formula *f, size_t end)
{
    size_t i, braces = 0, round = 0;
    int quoted = 0;
    for (i = f->at; i < end; i++) {
        char c = f->in.at[i];
        if (c == '"') quoted = !quoted;
        if (quoted) continue;
        if (c == '{') braces++;
        if (c == '(' || c == '[') round++;
        if (c == ')' || c == ']') {
            if (round == 0 && braces == 0) return f->in.size;
            if (round > 0) round--;
        }
        if (c == '}') {
            if (braces == 0) return f->in.size;
            braces--;
        }
        if (braces == 0 && round == 0) return i;
    }
    return f->in.size;
}

/* What stands between the opener at f->at and its closer; leaves f->at behind it. */
static void formula_inside(formula *f, text *out, size_t end)
{
    size_t close = formula_match(f, end);
    int aligned = f->aligned, operand = f->operand;
    if (close >= end) {
        formula_fail(f, "the bracket is not closed");
        return;
    }
    if (++f->depth > FORMULA_DEPTH) {
        formula_fail(f, "nested too deeply");
        return;
    }
    f->at++;
    f->aligned = f->operand = 0;
    text_put(out, "<mrow>");
    formula_row(f, out, close);
    text_put(out, "</mrow>");
    f->aligned = aligned;
    f->operand = operand;
    f->depth--;
    if (f->problem == NULL) f->at = close + 1;
}

static void formula_braces(formula *f, text *out, size_t end)
{
    formula_gap(f, end);
    if (span_at(f->in, f->at) == '{') formula_inside(f, out, end);
    else formula_fail(f, "a { is missing");
}

/* A pair of fences, as high as what they hold when that is more than a line. */
static void formula_fenced(formula *f, text *out, size_t end, const char *left, const char *right)
{
    text inside = { NULL, 0, 0 };
    int tall = f->tall;
    const char *stretchy;
    f->tall = 0;
    formula_inside(f, &inside, end);
    stretchy = f->tall ? "true" : "false";
    f->tall = f->tall || tall;
    text_format(out, "<mrow><mo form=\"prefix\" stretchy=\"%s\">%s</mo>", stretchy, left);
    text_put_span(out, span_of_text(&inside));
    text_format(out, "<mo form=\"postfix\" stretchy=\"%s\">%s</mo></mrow>", stretchy, right);
    text_free(&inside);
}

/* A parenthesis whose partner stands in another row is set alone. */
static void formula_parenthesis(formula *f, text *out, size_t end)
{
    size_t close = formula_match(f, end);
    char left[2], right[2];
    left[0] = f->in.at[f->at];
    left[1] = right[1] = 0;
    if (close < end) {
        right[0] = f->in.at[close];
        formula_fenced(f, out, end, left, right);
    } else {
        text_format(out, "<mo form=\"prefix\" stretchy=\"false\">%s</mo>", left);
        f->open++;
        f->at++;
    }
}

/* 0.5, .5, 12, and 1e-12 as a power of ten. */
static void formula_number(formula *f, text *out)
{
    size_t n = 0, m;
    span s = span_from(f->in, f->at);
    while (is_digit(span_at(s, n))) n++;
    if (span_at(s, n) == '.' && is_digit(span_at(s, n + 1)))
        for (n++; is_digit(span_at(s, n));) n++;
    m = n + 1 + (span_at(s, n + 1) == '-' || span_at(s, n + 1) == '+');
    if (span_at(s, n) == 'e' && is_digit(span_at(s, m))) {
        size_t exponent = m;
        while (is_digit(span_at(s, m))) m++;
        text_put(out, "<mrow>");
        if (!span_is(span_part(s, 0, n), "1")) text_format(out, "<mn>%.*s</mn><mo>&times;</mo>", (int)n, s.at);
        text_put(out, "<msup><mn>10</mn><mrow>");
        if (s.at[n + 1] == '-') text_put(out, "<mo form=\"prefix\">&minus;</mo>");
        text_format(out, "<mn>%.*s</mn></mrow></msup></mrow>", (int)(m - exponent), s.at + exponent);
        n = m;
    } else text_format(out, "<mn>%s%.*s</mn>", s.at[0] == '.' ? "0" : "", (int)n, s.at);
    f->at += n;
}

static int name_is_greek(span name)
{
    static const char *const letters[] = { "alpha",   "beta", "gamma", "delta",   "epsilon", "zeta",    "eta",
                                           "theta",   "iota", "kappa", "lambda",  "mu",      "nu",      "xi",
                                           "omicron", "pi",   "rho",   "sigma",   "tau",     "upsilon", "phi",
                                           "chi",     "psi",  "omega", "Gamma",   "Delta",   "Theta",   "Lambda",
                                           "Xi",      "Pi",   "Sigma", "Upsilon", "Phi",     "Psi",     "Omega" };
    size_t i;
    for (i = 0; i < sizeof letters / sizeof *letters; i++)
        if (span_is(name, letters[i])) return 1;
    return 0;
}

typedef struct {
    const char *name, *sign;
    char kind;
} named_sign;

/* A word is the name of a function, close to its argument, or else a piece of a sentence between blanks. */
static int name_is_function(span name, char next)
{
    static const char *const names[] = { "sin",  "cos",  "tan",  "cot", "exp", "log",
                                         "sinh", "cosh", "tanh", "Var", "Cov" };
    size_t i;
    for (i = 0; i < sizeof names / sizeof *names; i++)
        if (span_is(name, names[i])) return 1;
    return next != ' ' && next != 0;
}

/* Two letters that touch are a name only when they are one of these words or capitals, or an argument follows. */
static int pair_is_name(span name, char next)
{
    static const char *const words[] = { "as", "at", "by", "if", "in", "is", "of", "on", "or", "to" };
    size_t i;
    for (i = 0; i < sizeof words / sizeof *words; i++)
        if (span_is(name, words[i])) return 1;
    return next == '(' || (is_upper(name.at[0]) && is_upper(name.at[1]));
}

static const named_sign *sign_named(span name)
{
    static const named_sign signs[] = {
        { "sum", "<mo>&sum;</mo>", 'l' },
        { "prod", "<mo>&prod;</mo>", 'l' },
        { "int", "<mo>&int;</mo>", 'a' },
        { "min", "<mo movablelimits=\"true\" form=\"prefix\" lspace=\"0\" rspace=\"0\">min</mo>", 'l' },
        { "max", "<mo movablelimits=\"true\" form=\"prefix\" lspace=\"0\" rspace=\"0\">max</mo>", 'l' },
        { "lim", "<mo movablelimits=\"true\" form=\"prefix\" lspace=\"0\" rspace=\"0\">lim</mo>", 'l' },
        { "inf", "<mi>&infin;</mi>", 'a' },
        { "ln", "<mi>ln</mi>", 'f' },
        { "Ci", "<mi>Ci</mi>", 'f' },
        { "Re", "<mi>Re</mi>", 'f' },
        { "Im", "<mi>Im</mi>", 'f' },
        { "TV", "<mi>TV</mi>", 'f' },
        { "KL", "<mi>KL</mi>", 'f' }
    };
    size_t i;
    for (i = 0; i < sizeof signs / sizeof *signs; i++)
        if (span_is(name, signs[i].name)) return &signs[i];
    return NULL;
}

/* A variable: one letter or a Greek one, with the digits that touch it. */
static void formula_variable(formula *f, text *out, span name)
{
    size_t digits = 0;
    text letter = { NULL, 0, 0 };
    if (name.size == 1) text_format(&letter, "<mi>%c</mi>", name.at[0]);
    else
        text_format(&letter, "<mi%s>&%.*s;</mi>", is_upper(name.at[0]) ? " mathvariant=\"normal\"" : "",
                    (int)name.size, name.at);
    f->at += name.size;
    while (is_digit(span_at(f->in, f->at + digits))) digits++;
    if (digits > 0) text_put(out, "<msub>");
    text_put_span(out, span_of_text(&letter));
    if (digits > 0) text_format(out, "<mn>%.*s</mn></msub>", (int)digits, f->in.at + f->at);
    f->at += digits;
    text_free(&letter);
}

static void formula_pair(formula *f, atom *a, size_t end, const char *open, const char *close)
{
    text_put(&a->body, open);
    formula_braces(f, &a->body, end);
    formula_braces(f, &a->body, end);
    text_put(&a->body, close);
    f->tall = 1;
}

/* A name that opens a construct; 0 when it does not. */
static int formula_construct(formula *f, atom *a, size_t end, span name)
{
    char next = span_at(f->in, f->at + name.size);
    if (!(next == '{' && (span_is(name, "frac") || span_is(name, "binom") || span_is(name, "sqrt"))) &&
        !(next == '(' && span_is(name, "abs")))
        return 0;
    f->at += name.size;
    if (span_is(name, "frac")) formula_pair(f, a, end, "<mfrac>", "</mfrac>");
    else if (span_is(name, "binom"))
        formula_pair(f, a, end, "<mrow><mo stretchy=\"true\" form=\"prefix\">(</mo><mfrac linethickness=\"0\">",
                     "</mfrac><mo stretchy=\"true\" form=\"postfix\">)</mo></mrow>");
    else if (span_is(name, "abs")) formula_fenced(f, &a->body, end, "|", "|");
    else {
        text_put(&a->body, "<msqrt>");
        formula_braces(f, &a->body, end);
        text_put(&a->body, "</msqrt>");
    }
    return 1;
}

static void formula_name(formula *f, atom *a, size_t end)
{
    size_t n = 0;
    const named_sign *sign;
    span name;
    while (is_letter(span_at(f->in, f->at + n))) n++;
    name = span_part(f->in, f->at, n);
    if (formula_construct(f, a, end, name)) return;
    sign = sign_named(name);
    if (span_is(name, "E") && span_at(f->in, f->at + 1) != '_') { /* the expectation; E_n is an error, a variable */
        text_put(&a->body, "<mi mathvariant=\"normal\">E</mi>");
        a->kind = 'f';
        f->at++;
    } else if (n == 1 || name_is_greek(name)) formula_variable(f, &a->body, name);
    else if (sign != NULL) {
        if (a->kind == 'a') a->kind = sign->kind;
        text_put(&a->body, sign->sign);
        f->at += n;
    } else if (n == 2 && name.at[0] == 'd' && is_lower(name.at[1])) { /* a differential */
        text_format(&a->body, "<mrow><mspace width=\"0.17em\"/><mi mathvariant=\"normal\">d</mi><mi>%c</mi></mrow>",
                    name.at[1]);
        f->at += n;
    } else if (n == 2 && !pair_is_name(name, span_at(f->in, f->at + 2))) {
        if (f->script) formula_variable(f, &a->body, span_part(name, 0, 1));
        else formula_fail(f, "two letters that touch: a blank belongs between two variables");
    } else {
        while (is_digit(span_at(f->in, f->at + n))) n++;
        text_format(&a->body, "<mi>%.*s</mi>", (int)n, f->in.at + f->at);
        a->kind = (char)(name_is_function(name, span_at(f->in, f->at + n)) ? 'f' : 't');
        f->at += n;
    }
}

static void formula_quoted(formula *f, text *out, size_t end)
{
    size_t n = 1;
    int gap = f->at > 0 && is_blank(f->in.at[f->at - 1]) && f->operand;
    while (f->at + n < end && f->in.at[f->at + n] != '"') n++;
    if (f->at + n >= end) {
        formula_fail(f, "the quotes are not closed");
        return;
    }
    text_put(out, gap ? "<mtext>&nbsp;" : "<mtext>");
    text_escape(out, span_part(f->in, f->at + 1, n - 1));
    f->at += n + 1;
    text_put(out, is_blank(span_at(f->in, f->at)) && f->at < end ? "&nbsp;</mtext>" : "</mtext>");
}

static void formula_atom(formula *f, atom *a, size_t end)
{
    char c = span_at(f->in, f->at);
    if (is_digit(c) || (c == '.' && is_digit(span_at(f->in, f->at + 1)))) formula_number(f, &a->body);
    else if (is_letter(c)) formula_name(f, a, end);
    else if (c == '"') formula_quoted(f, &a->body, end);
    else if (c == '(' || c == '[') formula_parenthesis(f, &a->body, end);
    else if (c == '{') formula_inside(f, &a->body, end);
    else if (c == '*') formula_fail(f, "a star belongs right behind a letter (P*); a product needs no sign");
    else formula_fail(f, "this character has no meaning here");
}

typedef struct {
    const char *sign, *shown;
    char kind; /* '=' relation, '+' sign, 'm' a mark behind an operand, '.' the rest */
} operator_sign;

static const operator_sign *operator_find(span s)
{
    static const operator_sign operators[] = {
        { "...", "&hellip;", 'm' }, { "..", "&hellip;", 'm' }, { "->", "&rarr;", '.' },   { "=>", "&rArr;", '=' },
        { "<=", "&le;", '=' },      { ">=", "&ge;", '=' },     { "!=", "&ne;", '=' },     { "<<", "&#x226A;", '=' },
        { ">>", "&#x226B;", '=' },  { "+-", "&plusmn;", '+' }, { ":=", "&#x2254;", '=' }, { "=", "=", '=' },
        { "<", "&lt;", '=' },       { ">", "&gt;", '=' },      { "~", "&asymp;", '=' },   { "+", "+", '+' },
        { "-", "&minus;", '+' },    { "/", "/", '.' },         { ",", ",", '.' },         { ";", ";", '.' },
        { ":", ":", '.' },          { "|", "|", '.' },         { "!", "!", 'm' },         { "'", "&prime;", 'm' },
        { ".", "&sdot;", '.' }
    };
    size_t i;
    for (i = 0; i < sizeof operators / sizeof *operators; i++)
        if (span_starts(s, operators[i].sign)) return &operators[i];
    return NULL;
}

static void formula_operator(formula *f, text *out, const operator_sign *sign)
{
    const char *form = "";
    if (sign->kind == '+') form = f->operand ? " form=\"infix\"" : " form=\"prefix\"";
    else if (sign->sign[0] == '.') form = " lspace=\"0.17em\" rspace=\"0.17em\"";
    else if (sign->kind == 'm') form = " form=\"postfix\" lspace=\"0\" rspace=\"0\"";
    else if (span_is(span_of(sign->sign), "/")) form = " lspace=\"0\" rspace=\"0\"";
    else if (span_is(span_of(sign->sign), "|")) form = " stretchy=\"false\" lspace=\"0.2em\" rspace=\"0.2em\"";
    if (f->aligned && f->cells == 0 && sign->kind == '=') {
        text_put(out, "</mtd><mtd>");
        f->cells = 1;
    }
    text_format(out, "<mo%s>%s</mo>", form, sign->shown);
    f->at += strlen(sign->sign);
    f->operand = sign->kind == 'm';
}

/* A script is an atom, a sign with one, or a lone star or sign. */
static void formula_script(formula *f, text *out, size_t end)
{
    atom a = { { NULL, 0, 0 }, 'a' };
    char c;
    f->at++;
    c = span_at(f->in, f->at);
    text_put(out, "<mrow>");
    if (c == '*' || c == '+' || c == '-') {
        text_put(out, c == '*'   ? "<mo>&lowast;</mo>"
                      : c == '+' ? "<mo form=\"prefix\">+</mo>"
                                 : "<mo form=\"prefix\">&minus;</mo>");
        f->at++;
        c = span_at(f->in, f->at);
        if (c != '{' && !is_letter(c) && !is_digit(c)) c = 0;
    }
    f->script++;
    if (f->at >= end && c != 0) formula_fail(f, "a script is missing");
    if (c != 0) formula_atom(f, &a, end);
    f->script--;
    text_put_span(out, span_of_text(&a.body));
    text_put(out, "</mrow>");
    text_free(&a.body);
}

/* Reads one script of the given sign if it is there and not yet read. */
static int formula_scripts(formula *f, text *below, text *above, size_t end)
{
    char c = (char)(f->at < end ? span_at(f->in, f->at) : 0);
    if (c != '_' && c != '^') return 0;
    if ((c == '_' ? below : above)->size > 0) formula_fail(f, "a second script of the same kind");
    else formula_script(f, c == '_' ? below : above, end);
    return f->problem == NULL;
}

static void atom_put(text *out, const atom *a, const text *below, const text *above)
{
    int limits = a->kind == 'l';
    const char *element = below->size > 0 && above->size > 0 ? (limits ? "munderover" : "msubsup")
                          : below->size > 0                  ? (limits ? "munder" : "msub")
                          : above->size > 0                  ? (limits ? "mover" : "msup")
                                                             : NULL;
    if (element != NULL) text_format(out, "<%s>", element);
    text_put_span(out, span_of_text(&a->body));
    text_put_span(out, span_of_text(below));
    text_put_span(out, span_of_text(above));
    if (element != NULL) text_format(out, "</%s>", element);
}

static void formula_operand(formula *f, text *out, size_t end)
{
    atom a = { { NULL, 0, 0 }, 'a' };
    text below = { NULL, 0, 0 }, above = { NULL, 0, 0 };
    int before = f->operand;
    const char *space;
    formula_atom(f, &a, end);
    f->operand = 0;
    if (f->at < end && f->in.at[f->at] == '*' && is_letter(f->in.at[f->at - 1])) {
        text_put(&above, "<mo>&lowast;</mo>");
        f->at++;
    }
    space = a.kind == 't' ? "<mspace width=\"0.3em\"/>" : "<mspace width=\"0.17em\"/>";
    while (f->problem == NULL && formula_scripts(f, &below, &above, end)) continue;
    if (before && a.kind != 'a') text_put(out, space);
    atom_put(out, &a, &below, &above);
    if ((a.kind == 'f' || a.kind == 't') && f->at + 1 < end && f->in.at[f->at] == ' ' &&
        !operator_find(span_from(f->in, f->at + 1)))
        text_put(out, space);
    f->operand = 1;
    text_free(&a.body);
    text_free(&below);
    text_free(&above);
}

static void formula_row(formula *f, text *out, size_t end)
{
    while (f->problem == NULL) {
        size_t gap = formula_gap(f, end);
        const operator_sign *sign = operator_find(span_from(f->in, f->at));
        char c = span_at(f->in, f->at);
        if (f->at >= end) return;
        if (gap >= 3 && f->aligned && f->cells > 0) {
            text_put(out, "</mtd><mtd>");
            f->cells++;
        } else if (gap >= 3) text_put(out, "<mspace width=\"1.5em\"/>");
        if (c == ')' || c == ']') {
            text_format(out, "<mo form=\"postfix\" stretchy=\"false\">%c</mo>", c);
            if (--f->open < 0) formula_fail(f, "the bracket was never opened");
            f->operand = 1;
            f->at++;
        } else if (sign != NULL && !(c == '.' && is_digit(span_at(f->in, f->at + 1)))) formula_operator(f, out, sign);
        else formula_operand(f, out, end);
    }
}

/* One row of an aligned formula: what stands before its first relation is set to the left of a line. */
static void formula_aligned_row(formula *f, text *out, int first)
{
    text row = { NULL, 0, 0 };
    f->aligned = 1;
    f->cells = 0;
    f->operand = !first; /* a sign at the head of a further row is a binary one */
    formula_row(f, &row, f->in.size);
    text_put(out, f->cells > 0 ? "<mtr><mtd>" : "<mtr><mtd></mtd><mtd><mspace width=\"2em\"/>");
    text_put_span(out, span_of_text(&row));
    text_put(out, "</mtd></mtr>");
    text_free(&row);
}

static void formula_rows(formula *f, text *out, span rows)
{
    size_t begin = 0;
    span row;
    int first = 1;
    text_put(out, "<mtable displaystyle=\"true\">");
    while (f->problem == NULL && span_split(&rows, '\n', &row)) {
        f->in = row;
        f->at = span_indent(row);
        formula_aligned_row(f, out, first);
        if (f->problem != NULL) f->problem_at += begin;
        begin += row.size + 1;
        first = 0;
    }
    text_put(out, "</mtable>");
}

/* Writes the formula; returns 0, or what is wrong with it and where. */
static const char *formula_put(text *out, span words, int display, size_t *where)
{
    formula f;
    text math = { NULL, 0, 0 };
    size_t i;
    memset(&f, 0, sizeof f);
    f.in = words;
    if (display && span_find(words, "\n") < words.size) formula_rows(&f, &math, words);
    else formula_row(&f, &math, words.size);
    if (f.problem == NULL && f.open > 0) formula_fail(&f, "a bracket is not closed");
    text_put(out, display ? "<math display=\"block\" alttext=\"" : "<math alttext=\"");
    for (i = 0; i < words.size; i++) /* runs of blanks say nothing aloud */
        if (!is_blank(words.at[i])) text_escape(out, span_part(words, i, 1));
        else if (i > 0 && !is_blank(words.at[i - 1])) text_put(out, " ");
    text_put(out, "\"><mrow>");
    text_put_span(out, span_of_text(&math));
    text_put(out, "</mrow></math>");
    text_free(&math);
    *where = f.problem_at;
    return f.problem;
}

/* ---- Listings: C with its real line numbers, coloured, every name of the library a link. ---- */

typedef struct {
    weave *w;
    text *out;
    size_t number; /* of the line being written; 0: none are shown */
} listing;

static size_t cite_put(weave *w, text *out, span s, size_t i, size_t line);

static void line_open(listing *l)
{
    const char *home = l->w->writing->home;
    if (l->number == 0) text_put(l->out, "<span class=\"l\">");
    else if (at_home(l->w))
        text_format(l->out, "<span class=\"l\" id=\"L%lu\"><a class=\"n\" href=\"#L%lu\">%lu</a>",
                    (unsigned long)l->number, (unsigned long)l->number, (unsigned long)l->number);
    else
        text_format(l->out, "<span class=\"l\"><a class=\"n\" href=\"%s#L%lu\">%lu</a>", home,
                    (unsigned long)l->number, (unsigned long)l->number);
}

static void line_close(listing *l)
{
    text_put(l->out, "\n</span>");
    if (l->number > 0) l->number++;
}

/* A name as a link to its contract, or from the contract to the implementation. The first time a name stands on the
   line that declares or defines it, it is the place that the links go to. Returns 0 when metro.h does not know it. */
static int symbol_put(weave *w, text *out, span name, size_t line, int anchor)
{
    symbol *s = symbol_find(w, name);
    const char *home = w->writing->home;
    int size = (int)name.size, declares, defines;
    if (s == NULL) return 0;
    declares = anchor && s->declared > 0 && line == s->declared && !s->placed_declaration;
    defines = anchor && s->defined > 0 && line == s->defined && !s->placed_definition;
    if (declares) {
        s->placed_declaration = 1;
        if (s->defined == 0) text_format(out, "<b id=\"%.*s\">%.*s</b>", size, name.at, size, name.at);
        else
            text_format(out, "<a class=\"name\" id=\"%.*s\" href=\"#def-%.*s\">%.*s</a>", size, name.at, size,
                        name.at, size, name.at);
    } else if (defines) {
        s->placed_definition = 1;
        if (s->declared == 0) text_format(out, "<b id=\"%.*s\">%.*s</b>", size, name.at, size, name.at);
        else
            text_format(out, "<a class=\"name\" id=\"def-%.*s\" href=\"#%.*s\">%.*s</a>", size, name.at, size,
                        name.at, size, name.at);
    } else text_format(out, "<a href=\"%s#%.*s\">%.*s</a>", home, size, name.at, size, name.at);
    return 1;
}

/* A piece of a comment, within one line: citations and names are links. */
static void comment_put(listing *l, span piece)
{
    size_t i = 0;
    while (i < piece.size) {
        size_t n = cite_put(l->w, l->out, piece, i, l->number);
        if (n == 0) {
            n = span_word(piece, i);
            if (n == 0 || !symbol_put(l->w, l->out, span_part(piece, i, n), 0, 0))
                text_escape(l->out, span_part(piece, i, n > 0 ? n : 1));
            if (n == 0) n = 1;
        }
        i += n;
    }
}

static void token_put(listing *l, span token, token_kind kind)
{
    static const char *const classes[] = { "", "c", "s", "d", "", "" };
    span piece;
    int more = 0;
    while (span_split(&token, '\n', &piece)) {
        if (more) {
            line_close(l);
            line_open(l);
        }
        more = 1;
        if (piece.size == 0) continue;
        if (kind == WORD && symbol_put(l->w, l->out, piece, l->number, at_home(l->w) && l->number > 0)) continue;
        if (kind == WORD && word_is_keyword(piece)) text_put(l->out, "<span class=\"k\">");
        else if (classes[kind][0] != 0) text_format(l->out, "<span class=\"%s\">", classes[kind]);
        if (kind == COMMENT) comment_put(l, piece);
        else text_escape(l->out, piece);
        if (classes[kind][0] != 0 || (kind == WORD && word_is_keyword(piece))) text_put(l->out, "</span>");
    }
}

/* C code; `number` is the line of its first line in metro.h, or 0. */
static void code_put(weave *w, text *out, span code, size_t number)
{
    listing l;
    size_t i = 0;
    l.w = w;
    l.out = out;
    l.number = number;
    text_put(out, "<pre class=\"code\" tabindex=\"0\"><code>");
    line_open(&l);
    while (i < code.size) {
        token_kind kind;
        size_t n = token_read(code, i, &kind);
        token_put(&l, span_part(code, i, n), kind);
        i += n;
    }
    line_close(&l);
    text_put(out, "</code></pre>\n");
}

/* Lines of metro.h without the empty ones at both ends. */
static void listing_put(weave *w, text *out, size_t first, size_t last)
{
    const source *s = &w->book.from;
    while (first <= last && span_trim(s->line[first - 1]).size == 0) first++;
    while (first <= last && span_trim(s->line[last - 1]).size == 0) last--;
    if (first <= last) code_put(w, out, source_lines(s, first, last), first);
}

/* `[function: name]`: the function with the comment right above it. */
static void function_pull(weave *w, text *out, span name, size_t line)
{
    const symbol *s = symbol_find(w, name);
    if (s == NULL || s->defined == 0) {
        complain(w, line, "[function: %.*s]: metro.h defines no such function", (int)name.size, name.at);
        return;
    }
    w->pulling = 1;
    listing_put(w, out, s->from, s->last);
    w->pulling = 0;
}

/* ---- Values and figures, from the folder of results. ---- */

typedef struct {
    text bytes;
    span header[FIELDS], row[FIELDS];
    size_t columns, fields;
    span rest;
} table;

static size_t fields_split(span line, span *field)
{
    size_t n = 0;
    span piece;
    while (n < FIELDS && span_split(&line, ',', &piece)) {
        piece = span_trim(piece);
        if (piece.size >= 2 && piece.at[0] == '"' && piece.at[piece.size - 1] == '"')
            piece = span_part(piece, 1, piece.size - 2);
        field[n++] = piece;
    }
    return n;
}

/* The next line that is neither empty nor a comment. */
static int table_line(table *t, span *line)
{
    while (span_split(&t->rest, '\n', line)) {
        *line = span_trim(*line);
        if (line->size > 0 && line->at[0] != '#') return 1;
    }
    return 0;
}

static int table_row(table *t)
{
    span line;
    if (!table_line(t, &line)) return 0;
    t->fields = fields_split(line, t->row);
    return 1;
}

static size_t table_column(const table *t, span name)
{
    size_t i;
    for (i = 0; i < t->columns; i++)
        if (span_equal(t->header[i], name)) return i;
    return t->columns;
}

static double span_value(span s, int *valid)
{
    char copy[64], *end;
    double value = strtod(span_copy(s, copy, sizeof copy), &end);
    *valid = s.size > 0 && s.size < sizeof copy && *end == 0;
    return value;
}

/* Numbers are the same when they agree to nine digits, words when they are equal. */
static int cells_match(span a, span b)
{
    int number_a, number_b;
    double x = span_value(a, &number_a), y = span_value(b, &number_b);
    double off = (x - y) * (x - y), bound = 1e-18 * y * y; /* infinite or NaN: equal only to itself */
    if (number_a && number_b) return x == y || (off <= bound && bound < 1e300);
    return span_equal(a, b);
}

/* Whether the row meets each `column=value` of the selector; complains of a column that is not there. */
static int row_selected(weave *w, const table *t, span selector, size_t line, int *good)
{
    span part;
    while (span_split(&selector, ' ', &part)) {
        size_t equals = span_find(part, "="), column = table_column(t, span_part(part, 0, equals));
        if (part.size == 0) continue;
        if (equals == part.size || column == t->columns) {
            complain(w, line, "the selector '%.*s' names no column of the file", (int)part.size, part.at);
            *good = 0;
            return 0;
        }
        if (column >= t->fields || !cells_match(t->row[column], span_from(part, equals + 1))) return 0;
    }
    return 1;
}

/* Finds the cell; complains when it is not there or when several rows fit. */
static int table_find(weave *w, table *t, span selector, span name, size_t line, span *cell)
{
    size_t column, number = 0, found = 0, wanted = 0;
    int good = 1, valid;
    span head;
    t->rest = span_of_text(&t->bytes);
    t->columns = table_line(t, &head) ? fields_split(head, t->header) : 0;
    column = table_column(t, name);
    if (column == t->columns) {
        complain(w, line, "the file has no column '%.*s'", (int)name.size, name.at);
        return 0;
    }
    if (span_starts(selector, "row ")) {
        double row = span_value(span_trim(span_from(selector, 4)), &valid);
        wanted = valid && row >= 1 && row < 1e9 ? (size_t)row : 0;
        if (wanted == 0) complain(w, line, "rows are counted from 1");
        if (wanted == 0) return 0;
    }
    while (good && table_row(t)) {
        number++;
        if (wanted > 0 ? number != wanted : !row_selected(w, t, selector, line, &good)) continue;
        if (column < t->fields && found++ == 0) *cell = t->row[column];
    }
    if (good && found != 1)
        complain(w, line, "%lu rows fit '%.*s'", (unsigned long)found, (int)selector.size, selector.at);
    return good && found == 1;
}

/* A printed number as one reads it: a true minus, a power of ten. */
static void number_put(text *out, const char *digits)
{
    size_t exponent = strcspn(digits, "e");
    const char *power;
    if (strchr(digits, 'n') != NULL) exponent = strlen(digits); /* nan, inf */
    if (digits[0] == '-') text_put(out, "&minus;");
    text_put_bytes(out, digits + (digits[0] == '-'), exponent - (digits[0] == '-'));
    if (digits[exponent] == 0) return;
    text_put(out, "&nbsp;&times;&nbsp;10<sup>");
    power = digits + exponent + 1;
    if (*power == '-') text_put(out, "&minus;");
    while (*power == '+' || *power == '-' || (*power == '0' && power[1] != 0)) power++;
    text_put(out, power);
    text_put(out, "</sup>");
}

/* The formats are %s, %d, and %g %f %e with or without a precision up to 17. */
static int value_print(text *out, span cell, span format)
{
    char digits[400];
    int valid;
    size_t precision = 6;
    double value = span_value(cell, &valid);
    span rest = span_from(format, 1);
    if (span_is(format, "%s")) text_escape(out, cell);
    if (span_is(format, "%s")) return 1;
    if (span_at(format, 0) != '%' || !valid) return 0;
    if (span_at(rest, 0) == '.') {
        rest = span_from(rest, 1 + span_digits(rest, 1, &precision));
    }
    if (precision > 17 || rest.size != 1) return 0;
    if (rest.at[0] == 'g') snprintf(digits, sizeof digits, "%.*g", (int)precision, value);
    else if (rest.at[0] == 'f') snprintf(digits, sizeof digits, "%.*f", (int)precision, value);
    else if (rest.at[0] == 'e') snprintf(digits, sizeof digits, "%.*e", (int)precision, value);
    else if (rest.at[0] == 'd') snprintf(digits, sizeof digits, "%.0f", value);
    else return 0;
    number_put(out, digits);
    return 1;
}

/* Reads a file of the results; 0 when it is not there. Names that leave the folder are refused. */
static int result_read(weave *w, span name, size_t line, text *bytes)
{
    char path[1024], copy[256];
    if (name.size == 0 || name.size >= sizeof copy || name.at[0] == '/' || span_find(name, "..") < name.size) {
        complain(w, line, "'%.*s' is not the name of a file of results", (int)name.size, name.at);
        return 0;
    }
    snprintf(path, sizeof path, "%s/%s", w->results, span_copy(name, copy, sizeof copy));
    return file_read(path, bytes);
}

static void value_missing(text *out, span name, const char *why)
{
    text_put(out, "<span class=\"unmade\">[");
    text_escape(out, name);
    text_format(out, "%s]</span>", why);
}

/* `[value: file.csv, selector, column, format]`, without its brackets. */
static void value_put(weave *w, text *out, span words, size_t line)
{
    static const table empty;
    span field[FIELDS], cell;
    size_t n = fields_split(words, field);
    table *t;
    if (n != 4) {
        complain(w, line, "a value is written [value: file.csv, selector, column, format]");
        return;
    }
    t = (table *)memory_grow(NULL, sizeof *t);
    *t = empty;
    if (!result_read(w, field[0], line, &t->bytes)) value_missing(out, field[0], ": run <code>make paper</code>");
    else if (!table_find(w, t, field[1], field[2], line, &cell)) value_missing(out, field[0], " has no such value");
    else if (!value_print(out, cell, field[3]))
        complain(w, line, "the cell '%.*s' does not print as %.*s", (int)cell.size, cell.at, (int)field[3].size,
                 field[3].at);
    text_free(&t->bytes);
    free(t);
}

static void base64_put(text *out, const text *bytes)
{
    static const char digits[] = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    size_t i, j;
    for (i = 0; i < bytes->size; i += 3) {
        unsigned long three = 0;
        char four[4];
        for (j = 0; j < 3; j++) three = three << 8 | (i + j < bytes->size ? (unsigned char)bytes->data[i + j] : 0u);
        for (j = 0; j < 4; j++)
            four[j] = (char)(j > 0 && i + j > bytes->size ? '=' : digits[three >> (18 - 6 * j) & 63]);
        text_put_bytes(out, four, 4);
    }
}

static void image_put(weave *w, text *out, span name, span caption, const text *bytes, size_t line)
{
    span all = span_of_text(bytes);
    size_t begin = span_find(all, "<svg"), end = all.size;
    if (span_starts(all, "\x89PNG")) {
        text_put(out, "<img alt=\"");
        text_escape(out, caption);
        text_put(out, "\" src=\"data:image/png;base64,");
        base64_put(out, bytes);
        text_put(out, "\">");
        return;
    }
    while (end > begin && !span_starts(span_from(all, end), "</svg>")) end--;
    if (begin >= end) complain(w, line, "%.*s is neither SVG nor PNG", (int)name.size, name.at);
    else text_put_span(out, span_part(all, begin, end + 6 - begin));
}

/* ---- Prose: what stands inside a paragraph. Each piece takes characters from i on and returns how many. ---- */

static size_t line_at(span s, size_t i, size_t line)
{
    size_t j;
    for (j = 0; j < i && j < s.size; j++)
        if (s.at[j] == '\n') line++;
    return line;
}

static const heading *heading_find(const weave *w, span number)
{
    size_t i;
    for (i = 0; i < w->book.heading_count; i++)
        if (span_equal(w->book.headings[i].number, number)) return &w->book.headings[i];
    return NULL;
}

static const equation *equation_find(const weave *w, span tag)
{
    size_t i;
    for (i = 0; i < w->equation_count; i++)
        if (span_equal(w->equations[i].tag, tag)) return &w->equations[i];
    return NULL;
}

static void link_put(weave *w, text *out, const char *kind, span target, span shown)
{
    text_format(out, "<a href=\"%s#%s-%.*s\">", w->writing->home, kind, (int)target.size, target.at);
    text_escape(out, shown);
    text_put(out, "</a>");
}

static void equation_cite(weave *w, text *out, span tag, span shown, size_t line)
{
    if (w->collecting && at_home(w)) {
        w->citations = (citation *)array_grow(w->citations, w->citation_count, sizeof *w->citations);
        span_copy(tag, w->citations[w->citation_count].tag, sizeof w->citations->tag);
        w->citations[w->citation_count++].line = line;
    }
    if (equation_find(w, tag) == NULL) complain(w, line, "eq %.*s does not exist", (int)tag.size, tag.at);
    link_put(w, out, "eq", tag, shown);
}

static void heading_cite(weave *w, text *out, span number, span shown, size_t line)
{
    if (heading_find(w, number) == NULL) complain(w, line, "%.*s does not exist", (int)shown.size, shown.at);
    link_put(w, out, "sec", number, shown);
}

/* `paper (12)` goes to its row of the table; `paper 2.1`, a section of the paper, to the table as a whole. */
static size_t paper_cite(weave *w, text *out, span s, size_t i, size_t n, size_t line)
{
    size_t digits, number;
    span shown;
    if (span_at(s, i + n) != '(') {
        size_t section = is_digit(span_at(s, i + n)) ? span_number(s, i + n) : 0;
        if (section == 0 || span_find(span_part(s, i + n, section), ".") == section) return 0;
        link_put(w, out, "paper", span_of("equations"), span_part(s, i, n + section));
        return n + section;
    }
    digits = span_digits(s, i + n + 1, &number);
    if (digits == 0 || span_at(s, i + n + 1 + digits) != ')') return 0;
    shown = span_part(s, i, n + digits + 2);
    if (number < 1 || number > PAPER_EQUATIONS || w->paper_line[number] == 0)
        complain(w, line, "%.*s is in no row of the table of the paper's equations", (int)shown.size, shown.at);
    link_put(w, out, "paper", span_part(s, i + n + 1, digits), shown);
    return shown.size;
}

/* eq 5.3, chapter 5, section 5.2, appendix A, paper (12): a link. "The paper's section 2" is none of ours. */
static size_t cite_put(weave *w, text *out, span s, size_t i, size_t line)
{
    static const char *const words[] = { "eq", "chapter", "section", "appendix", "paper" };
    size_t n = span_word(s, i), k, gap, number;
    char first = span_at(s, i);
    span shown, target;
    if (n == 0 || (i > 0 && is_word(s.at[i - 1]))) return 0;
    for (k = 0; k < 5; k++)
        if (n == strlen(words[k]) && (first | 32) == words[k][0] && span_starts(span_from(s, i + 1), words[k] + 1))
            break;
    if (k == 5 || (k == 2 && i >= 8 && span_starts(span_from(s, i - 8), "paper's "))) return 0;
    for (gap = n; is_blank(span_at(s, i + gap)); gap++) continue;
    if (gap == n) return 0;
    if (k == 4) return paper_cite(w, out, s, i, gap, line_at(s, i, line));
    number = span_number(s, i + gap);
    shown = span_part(s, i, gap + number);
    target = span_part(s, i + gap, number);
    if (number == 0 || ((k == 0 || k == 2) && span_find(target, ".") == number)) return 0;
    if (k != 3 && !is_digit(target.at[number - 1])) return 0;
    if (k == 0) equation_cite(w, out, target, shown, line_at(s, i, line));
    else heading_cite(w, out, target, shown, line_at(s, i, line));
    return shown.size;
}

/* Code in prose: every name of the library in it is a link, and must exist. */
static void names_put(weave *w, text *out, span code, size_t line)
{
    size_t i = 0;
    while (i < code.size) {
        size_t n = span_word(code, i);
        span word = span_part(code, i, n > 0 ? n : 1);
        int known = n > 0 && symbol_put(w, out, word, line, 0);
        if (!known) text_escape(out, word);
        if (!known && w->check && (span_starts(word, "metro_") || span_starts(word, "metroi_")) &&
            word.at[word.size - 1] != '_')
            complain(w, line, "metro.h declares no %.*s", (int)word.size, word.at);
        i += word.size;
    }
}

static size_t inline_code(weave *w, text *out, span s, size_t i, size_t line)
{
    size_t n = 1;
    if (s.at[i] != '`') return 0;
    while (i + n < s.size && s.at[i + n] != '`') n++;
    if (i + n == s.size) {
        complain(w, line_at(s, i, line), "a backtick has no partner");
        return 0;
    }
    text_put(out, "<code>");
    names_put(w, out, span_part(s, i + 1, n - 1), line_at(s, i, line));
    text_put(out, "</code>");
    return n + 1;
}

static void formula_complain(weave *w, size_t line, const char *what, span words, size_t where, const char *problem)
{
    char near[24];
    span rest = span_from(words, where);
    rest = span_part(rest, 0, span_find(rest, "\n"));
    span_copy(rest, near, sizeof near);
    if (rest.size > 0) complain(w, line, "%s, at '%s': %s", what, near, problem);
    else complain(w, line, "%s, at its end: %s", what, problem);
}

static size_t inline_formula(weave *w, text *out, span s, size_t i, size_t line)
{
    size_t n = 1, where;
    const char *problem;
    span words;
    if (s.at[i] != '$') return 0;
    while (i + n < s.size && s.at[i + n] != '$') n++;
    if (i + n == s.size) {
        complain(w, line_at(s, i, line), "a dollar sign has no partner");
        return 0;
    }
    words = span_part(s, i + 1, n - 1);
    problem = formula_put(out, words, 0, &where);
    if (problem != NULL) formula_complain(w, line_at(s, i + 1 + where, line), "formula", words, where, problem);
    return n + 1;
}

static size_t inline_value(weave *w, text *out, span s, size_t i, size_t line)
{
    span rest = span_from(s, i);
    size_t n = span_find(rest, "]");
    if (!span_starts(rest, "[value:")) return 0;
    if (n == rest.size) {
        complain(w, line_at(s, i, line), "the bracket of the value is not closed");
        return 0;
    }
    value_put(w, out, span_part(rest, 7, n - 7), line_at(s, i, line));
    return n + 1;
}

static void prose_inline(weave *w, text *out, span s, size_t line);

/* [text](address): a link to another lecture NAME.md becomes one to its page. */
static size_t inline_link(weave *w, text *out, span s, size_t i, size_t line)
{
    span rest = span_from(s, i), address;
    size_t close = span_find(rest, "]("), end;
    if (s.at[i] != '[' || close == rest.size || span_find(span_part(rest, 0, close), "\n\n") < close) return 0;
    end = span_find(span_from(rest, close), ")");
    if (close + end == rest.size) return 0;
    address = span_part(rest, close + 2, end - 2);
    text_put(out, "<a href=\"");
    if (address.size > 3 && span_is(span_from(address, address.size - 3), ".md") &&
        span_find(address, "/") == address.size) {
        text_escape(out, span_part(address, 0, address.size - 3));
        text_put(out, ".html");
    } else text_escape(out, address);
    text_put(out, "\">");
    prose_inline(w, out, span_part(rest, 1, close - 1), line_at(s, i, line));
    text_put(out, "</a>");
    return close + end + 1;
}

/* An index or an exponent: a word or what stands in braces; `i` is its place. Returns how much of s it takes. */
static size_t inline_script(weave *w, text *out, span s, size_t i, const char *element, size_t line)
{
    size_t minus = span_at(s, i) == '-', n = span_word(s, i + minus);
    span script = span_part(s, i + minus, n);
    if (n == 0 && span_at(s, i) == '{') {
        n = span_find(span_from(s, i), "}") + 1;
        if (i + n > s.size) return 0;
        script = span_part(s, i + 1, n - 2);
    }
    if (n == 0) return 0;
    text_format(out, "<%s>%s", element, n == script.size && minus ? "&minus;" : "");
    prose_inline(w, out, script, line);
    text_format(out, "</%s>", element);
    return n + (n == script.size ? minus : 0);
}

/* Simple mathematics needs no dollars: the Greek alphabet, and x_n, x_{n+1} behind a single letter. */
static size_t inline_variable(weave *w, text *out, span s, size_t i, size_t line)
{
    size_t word = span_word(s, i), n = 0, script = 0;
    text index = { NULL, 0, 0 };
    while (n < word && is_letter(s.at[i + n])) n++;
    if ((n != 1 && !name_is_greek(span_part(s, i, n))) || (n < word && s.at[i + n] != '_')) return 0;
    if (n < word) script = inline_script(w, &index, s, i + n + 1, "sub", line_at(s, i, line));
    if (n == 1 || (n < word && script == 0)) text_put_span(out, span_part(s, i, n));
    else text_format(out, "&%.*s;", (int)n, s.at + i);
    text_put_span(out, span_of_text(&index));
    text_free(&index);
    return script > 0 ? n + 1 + script : n;
}

/* A name of the library, or an address. */
static size_t inline_word(weave *w, text *out, span s, size_t i, size_t line)
{
    size_t n = span_word(s, i);
    span word = span_part(s, i, n);
    if (n == 0 || (i > 0 && is_word(s.at[i - 1]))) return 0;
    if (span_starts(span_from(s, i), "https://") || span_starts(span_from(s, i), "http://")) {
        for (n = 0; i + n < s.size && !is_blank(s.at[i + n]) && strchr("<>)\"", s.at[i + n]) == NULL;) n++;
        while (n > 0 && strchr(".,;:", s.at[i + n - 1]) != NULL) n--;
        text_put(out, "<a href=\"");
        text_escape(out, span_part(s, i, n));
        text_put(out, "\">");
        text_escape(out, span_part(s, i, n));
        text_put(out, "</a>");
        return n;
    }
    if (!span_starts(word, "metro_") && !span_starts(word, "METRO_") && !span_starts(word, "metroi_"))
        return inline_variable(w, out, s, i, line);
    text_put(out, "<code>");
    names_put(w, out, word, line_at(s, i, line));
    text_put(out, "</code>");
    return n;
}

/* What the keyboard lacks: dashes, quotes, signs of relation, exponents such as 2^-53. */
static size_t inline_sign(weave *w, text *out, span s, size_t i, size_t line)
{
    static const char *const signs[][2] = { { "...", "&hellip;" }, { "->", "&rarr;" }, { "<=", "&le;" },
                                            { ">=", "&ge;" },      { "!=", "&ne;" },   { "+-", "&plusmn;" } };
    char before = (char)(i > 0 ? s.at[i - 1] : ' '), c = s.at[i], next = span_at(s, i + 1);
    size_t k;
    for (k = 0; k < sizeof signs / sizeof *signs; k++) {
        if (!span_starts(span_from(s, i), signs[k][0])) continue;
        text_put(out, signs[k][1]);
        return strlen(signs[k][0]);
    }
    if (c == '"') text_put(out, is_blank(before) || before == '(' ? "&ldquo;" : "&rdquo;");
    else if (c == '\'') text_put(out, is_blank(before) || before == '(' ? "&lsquo;" : "&rsquo;");
    else if (c == '-' && is_blank(before) && is_blank(span_at(s, i + 1))) text_put(out, "&ndash;");
    else if (c == '-' && !is_word(before) &&
             (next == '.' || is_digit(next) || name_is_greek(span_part(s, i + 1, span_word(s, i + 1)))))
        text_put(out, "&minus;");
    else if (c == '^' && (is_word(before) || before == ')' || before == '}')) {
        size_t n = inline_script(w, out, s, i + 1, "sup", line);
        return n > 0 ? n + 1 : 0;
    } else return 0;
    return 1;
}

/* Lectures may stress *a word* or **a word** as Markdown does; in metro.h a star is a star. */
static size_t inline_stress(weave *w, text *out, span s, size_t i, size_t line)
{
    size_t stars = span_at(s, i + 1) == '*' ? 2 : 1, n;
    if (!w->writing->lecture || s.at[i] != '*' || is_blank(span_at(s, i + stars))) return 0;
    n = span_find(span_from(s, i + stars), stars == 2 ? "**" : "*");
    if (i + stars + n == s.size || n == 0 || is_blank(s.at[i + stars + n - 1])) return 0;
    text_put(out, stars == 2 ? "<strong>" : "<em>");
    prose_inline(w, out, span_part(s, i + stars, n), line_at(s, i, line));
    text_put(out, stars == 2 ? "</strong>" : "</em>");
    return n + 2 * stars;
}

static void prose_inline(weave *w, text *out, span s, size_t line)
{
    size_t i = 0;
    while (i < s.size) {
        size_t n = inline_code(w, out, s, i, line);
        if (n == 0) n = inline_formula(w, out, s, i, line);
        if (n == 0) n = inline_value(w, out, s, i, line);
        if (n == 0) n = inline_link(w, out, s, i, line);
        if (n == 0) n = cite_put(w, out, s, i, line);
        if (n == 0) n = inline_word(w, out, s, i, line);
        if (n == 0) n = inline_stress(w, out, s, i, line);
        if (n == 0) n = inline_sign(w, out, s, i, line);
        if (n == 0) text_escape(out, span_part(s, i, 1));
        i += n > 0 ? n : 1;
    }
}

/* ---- Prose: paragraphs and what stands between them. ---- */

/* Lines of prose without the comment's marks and indent; `first` is the number of the first. */
typedef struct {
    span *line;
    size_t count, first;
} prose;

static prose prose_of_comment(const source *s, size_t first, size_t last)
{
    prose p;
    size_t i;
    p.count = last - first + 1;
    p.first = first;
    p.line = (span *)memory_grow(NULL, p.count * sizeof *p.line);
    for (i = 0; i < p.count; i++) {
        span line = s->line[first + i - 1];
        size_t indent = span_indent(line);
        if (i == 0) line = span_from(line, span_at(line, 2) == ' ' ? 3 : 2);
        else line = span_from(line, indent < PROSE_INDENT ? indent : PROSE_INDENT);
        if (i == p.count - 1) line = span_part(line, 0, span_find(line, "*/"));
        while (line.size > 0 && line.at[line.size - 1] == ' ') line.size--;
        p.line[i] = line;
    }
    return p;
}

static span prose_line(const prose *p, size_t i) { return i < p->count ? p->line[i] : span_make("", 0); }

/* The number of lines from i on that stand in the block: indented by four more; empty lines inside belong to it. */
static size_t block_size(const prose *p, size_t i)
{
    size_t n = 0, last = 0;
    for (; i + n < p->count; n++) {
        if (p->line[i + n].size == 0) continue;
        if (span_indent(p->line[i + n]) < BLOCK_INDENT) break;
        last = n + 1;
    }
    return last;
}

/* The tag at the end of a line, as in "(5.1)", and what stands before it; the tag is empty without. */
static span tag_read(span line, span *before)
{
    size_t open = line.size, n;
    *before = line;
    while (open > 0 && line.at[open - 1] != '(') open--;
    n = open > 0 ? span_number(line, open) : 0;
    if (n == 0 || open + n + 1 != line.size || line.at[open + n] != ')' ||
        span_find(span_part(line, open, n), ".") == n ||
        (open > 1 && !(open > 2 && line.at[open - 2] == ' ' && line.at[open - 3] == ' ')))
        return span_make("", 0);
    *before = span_part(line, 0, open - 1);
    while (before->size > 0 && before->at[before->size - 1] == ' ') before->size--;
    return span_part(line, open, n);
}

/* The number of lines of the equation that begins at i, up to its tag; 0 when an empty line comes first. */
static size_t equation_size(const prose *p, size_t i, size_t lines)
{
    size_t n;
    span before;
    for (n = 0; n < lines && p->line[i + n].size > 0; n++)
        if (tag_read(p->line[i + n], &before).size > 0) return n + 1;
    return 0;
}

/* Under an equation: the functions that cite it with their lines, or else the places of the prose. */
static void references_put(weave *w, text *out, span tag)
{
    size_t i;
    const symbol *before = NULL;
    int any = 0;
    for (i = 0; i < w->citation_count; i++) {
        size_t line = w->citations[i].line;
        const symbol *s = span_is(tag, w->citations[i].tag) ? symbol_around(w, line) : NULL;
        if (s == NULL) continue;
        if (line < s->defined) line = s->defined; /* in the comment above: no line of a listing */
        text_put(out, !any ? "code: " : s == before ? ", " : "; ");
        if (s != before) {
            symbol_put(w, out, s->name, 0, 0);
            text_put(out, ", line ");
        }
        text_format(out, "<a href=\"%s#L%lu\">%lu</a>", w->writing->home, (unsigned long)line, (unsigned long)line);
        before = s;
        any = 1;
    }
}

/* The headings under which the prose cites the equation, each once; its own is left out. */
static void mentions_put(weave *w, text *out, span tag, const heading *own)
{
    size_t i, k;
    const heading *before = own;
    int any = 0;
    for (i = 0; i < w->citation_count; i++) {
        const heading *h = NULL;
        if (!span_is(tag, w->citations[i].tag) || symbol_around(w, w->citations[i].line) != NULL) continue;
        for (k = 0; k < w->book.heading_count && w->book.headings[k].line <= w->citations[i].line; k++)
            if (w->book.headings[k].number.size > 0) h = &w->book.headings[k];
        if (h == NULL || h == before || h == own) continue;
        text_put(out, any ? ", " : "text: ");
        link_put(w, out, "sec", h->number, h->number);
        before = h;
        any = 1;
    }
}

static const heading *heading_above(const weave *w, size_t line)
{
    const heading *h = NULL;
    size_t i;
    for (i = 0; i < w->book.heading_count && w->book.headings[i].line <= line; i++) h = &w->book.headings[i];
    return h;
}

static void equation_register(weave *w, span tag, size_t line, span rows)
{
    equation *e;
    text flat = { NULL, 0, 0 };
    size_t where, i;
    if (!w->collecting || w->writing->lecture) return;
    w->equations = (equation *)array_grow(w->equations, w->equation_count, sizeof *w->equations);
    e = &w->equations[w->equation_count++];
    memset(e, 0, sizeof *e);
    e->tag = tag;
    e->line = line;
    for (i = 0; i < rows.size; i++) /* one row in the index, with a gap between the rows */
        text_put_bytes(&flat, rows.at[i] == '\n' ? "   " : rows.at + i, rows.at[i] == '\n' ? 3 : 1);
    formula_put(&e->formula, span_of_text(&flat), 0, &where);
    text_free(&flat);
}

/* The rows of an equation without their common indent and without the tag. */
static span equation_rows(const prose *p, size_t i, size_t n, text *rows)
{
    size_t k, indent = span_indent(p->line[i]);
    span before, tag = span_make("", 0);
    for (k = 0; k < n; k++) {
        tag = tag_read(p->line[i + k], &before);
        if (span_trim(before).size == 0) continue;
        if (rows->size > 0) text_put(rows, "\n");
        text_put_span(rows, span_from(before, span_indent(before) < indent ? span_indent(before) : indent));
    }
    return tag;
}

static void equation_put(weave *w, text *out, const prose *p, size_t i, size_t n)
{
    text rows = { NULL, 0, 0 }, math = { NULL, 0, 0 };
    size_t line = p->first + i, where = 0, k;
    span tag = equation_rows(p, i, n, &rows), words = span_of_text(&rows);
    const char *problem = formula_put(&math, words, 1, &where), *home = w->writing->lecture ? "l" : "";
    equation_register(w, tag, line, words);
    if (problem != NULL) {
        char what[32] = "eq ";
        span_copy(tag, what + 3, sizeof what - 3);
        formula_complain(w, line_at(words, where, line), what, words, where, problem);
        text_format(out, "<pre class=\"broken\" id=\"%seq-%.*s\">", home, (int)tag.size, tag.at);
        for (k = 0; k < n; k++) {
            text_escape(out, p->line[i + k]);
            text_put(out, "\n");
        }
        text_put(out, "</pre>\n");
    } else {
        text_format(out, "<div class=\"equation\" id=\"%seq-%.*s\"><div class=\"formula\" tabindex=\"0\">", home,
                    (int)tag.size, tag.at);
        text_put_span(out, span_of_text(&math));
        text_format(out, "</div><a class=\"tag\" href=\"#%seq-%.*s\">(%.*s)</a></div>\n", home, (int)tag.size, tag.at,
                    (int)tag.size, tag.at);
    }
    text_free(&math);
    if (!w->writing->lecture) references_put(w, &math, tag);
    if (!w->writing->lecture && math.size == 0) mentions_put(w, &math, tag, heading_above(w, line));
    if (math.size > 0) {
        text_put(out, "<p class=\"back\">");
        text_put_span(out, span_of_text(&math));
        text_put(out, "</p>\n");
    }
    text_free(&math);
    text_free(&rows);
}

/* The number that a line of the contents begins with, after an optional "# "; its title ends at two blanks. */
static int contents_entry(span line, span *number, span *title)
{
    size_t n;
    line = span_trim(line);
    if (span_starts(line, "# ")) line = span_trim(span_from(line, 2));
    n = span_number(line, 0);
    *number = span_part(line, 0, n);
    *title = span_trim(span_from(line, n));
    *title = span_trim(span_part(*title, 0, span_find(*title, "  ")));
    return n > 0 && span_at(line, n) == ' ' && title->size > 0;
}

/* Whether the block stands in the first comment and each of its lines reads like a heading. */
static int contents_are(const weave *w, const prose *p, size_t i, size_t n)
{
    size_t k;
    span number, title;
    if (w->writing->lecture || w->block_count == 0 || p->first != w->blocks[0].first) return 0;
    for (k = 0; k < n; k++)
        if (p->line[i + k].size > 0 && !contents_entry(p->line[i + k], &number, &title)) return 0;
    return n > 1;
}

static void contents_put(weave *w, text *out, const prose *p, size_t i, size_t n)
{
    size_t k;
    span number, title;
    text_put(out, "<ul class=\"contents\">\n");
    for (k = 0; k < n; k++) {
        if (!contents_entry(p->line[i + k], &number, &title)) continue;
        text_put(out, span_find(number, ".") < number.size ? "<li class=\"sub\">" : "<li>");
        link_put(w, out, "sec", number, number);
        text_put(out, " ");
        prose_inline(w, out, title, p->first + i + k);
        text_put(out, "</li>\n");
    }
    text_put(out, "</ul>\n");
}

/* A complete program in the prose is written out for the build to compile; #line brings its errors home. */
static void example_keep(weave *w, const text *code, size_t line)
{
    text program = { NULL, 0, 0 };
    char name[64];
    if (w->extract == NULL || w->collecting) return;
    if (span_find(span_of_text(code), "#include \"metro.h\"") == code->size) return;
    if (span_find(span_of_text(code), "int main(") == code->size) return;
    snprintf(name, sizeof name, "example_%lu.c", (unsigned long)++w->examples);
    text_format(&program, "#line %lu \"%s\"\n", (unsigned long)line, w->writing->from.path);
    text_put_span(&program, span_of_text(code));
    text_put(&program, "\n");
    if (file_write(w, w->extract, name, &program)) printf("%s/%s\n", w->extract, name);
    text_free(&program);
}

/* Lines i to i + n - 1 as they stand, less their common indent. */
static void verbatim_put(weave *w, text *out, const prose *p, size_t i, size_t n)
{
    text code = { NULL, 0, 0 };
    size_t k, indent = COLUMNS;
    for (k = 0; k < n; k++)
        if (p->line[i + k].size > 0 && span_indent(p->line[i + k]) < indent) indent = span_indent(p->line[i + k]);
    for (k = 0; k < n; k++) {
        if (k > 0) text_put(&code, "\n");
        text_put_span(&code, span_from(p->line[i + k], indent));
    }
    if (span_find(span_of_text(&code), "#include") < code.size || span_find(span_of_text(&code), ";") < code.size)
        code_put(w, out, span_of_text(&code), 0);
    else {
        text_put(out, "<pre class=\"plain\" tabindex=\"0\">");
        names_put(w, out, span_of_text(&code), p->first + i);
        text_put(out, "</pre>\n");
    }
    example_keep(w, &code, p->first + i);
    text_free(&code);
}

/* Indented lines: equations end in a tag, the rest is the contents, a program or verbatim text. */
static size_t block_put(weave *w, text *out, const prose *p, size_t i)
{
    size_t n = block_size(p, i), k = 0, first = 0;
    if (contents_are(w, p, i, n)) {
        contents_put(w, out, p, i, n);
        return n;
    }
    while (k < n) {
        size_t lines = k == 0 || p->line[i + k - 1].size == 0 || k == first ? equation_size(p, i + k, n - k) : 0;
        if (p->line[i + k].size == 0 && k == first) first = ++k;
        else if (lines == 0) k++;
        else {
            if (k > first) verbatim_put(w, out, p, i + first, k - first);
            equation_put(w, out, p, i + k, lines);
            first = k += lines;
        }
    }
    if (n > first) verbatim_put(w, out, p, i + first, n - first);
    return n;
}

/* Three backticks around lines, as in Markdown. */
static size_t fence_put(weave *w, text *out, const prose *p, size_t i)
{
    size_t n = 1;
    while (i + n < p->count && !span_starts(p->line[i + n], "```")) n++;
    if (i + n == p->count) complain(w, p->first + i, "the fence is not closed");
    if (n > 1) verbatim_put(w, out, p, i + 1, n - 1);
    return i + n < p->count ? n + 1 : n;
}

static const heading *heading_register(weave *w, span number, span title, size_t line, size_t level)
{
    page *p = w->writing;
    size_t i;
    if (w->collecting) {
        p->headings = (heading *)array_grow(p->headings, p->heading_count, sizeof *p->headings);
        p->headings[p->heading_count].number = number;
        p->headings[p->heading_count].title = title;
        p->headings[p->heading_count].line = line;
        p->headings[p->heading_count++].level = level;
        return &p->headings[p->heading_count - 1];
    }
    for (i = 0; i + 1 < p->heading_count && p->headings[i].line != line; i++) continue;
    return &p->headings[i];
}

static void anchor_put(text *out, const page *p, const heading *h)
{
    if (h->number.size > 0 && !p->lecture) text_format(out, "sec-%.*s", (int)h->number.size, h->number.at);
    else text_format(out, "part-%lu", (unsigned long)(h - p->headings) + 1);
}

/* In metro.h the number tells the level; in a lecture the number of signs does. */
static void heading_put(weave *w, text *out, span line, size_t number)
{
    const heading *h;
    size_t signs = 0, n, level;
    span title;
    while (span_at(line, signs) == '#') signs++;
    title = span_trim(span_from(line, signs));
    n = w->writing->lecture ? 0 : span_number(title, 0);
    if (n > 0 && span_at(title, n) != ' ') n = 0;
    level = signs;
    if (!w->writing->lecture) {
        size_t i;
        for (level = 2, i = 0; i < n; i++) level += title.at[i] == '.';
        if (n == 0 && w->block_count > 0 && number == w->blocks[0].first) level = 1;
    }
    if (level > 4) level = 4;
    h = heading_register(w, span_part(title, 0, n), span_trim(span_from(title, n)), number, level);
    text_format(out, "<h%lu id=\"", (unsigned long)level);
    anchor_put(out, w->writing, h);
    text_put(out, "\">");
    if (n > 0) text_format(out, "<a class=\"self\" href=\"#sec-%.*s\">%.*s</a> ", (int)n, title.at, (int)n, title.at);
    prose_inline(w, out, h->title, number);
    text_format(out, "</h%lu>\n", (unsigned long)level);
}

/* Cells end at bars, but not at those inside backticks or dollar signs. */
static int cell_split(span *rest, span *cell)
{
    size_t n = 0;
    char inside = 0;
    if (rest->size == 0) return 0;
    for (; n < rest->size; n++) {
        char c = rest->at[n];
        if (inside == 0 && c == '|') break;
        if (c == '`' || c == '$') inside = (char)(inside == 0 ? c : inside == c ? 0 : inside);
    }
    *cell = span_trim(span_part(*rest, 0, n));
    *rest = span_from(*rest, n + 1);
    return 1;
}

/* The first cell `paper (12)` maps that equation; it may name several. */
static int paper_register(weave *w, text *out, span cell, size_t line)
{
    size_t i;
    int any = 0;
    if (w->writing->lecture || !span_starts(cell, "paper (")) return 0;
    for (i = 6; i < cell.size; i++) {
        size_t number;
        if (cell.at[i] != '(' || span_digits(cell, i + 1, &number) == 0 || number > PAPER_EQUATIONS) continue;
        if (w->paper_line[number] != 0 && w->paper_line[number] != line)
            complain(w, line, "paper (%lu) is mapped in line %lu already", (unsigned long)number,
                     (unsigned long)w->paper_line[number]);
        if (w->collecting && w->paper_line[number] == 0) w->paper_line[number] = line;
        text_format(out, "<span id=\"paper-%lu\"></span>", (unsigned long)number);
        any = 1;
    }
    return any;
}

static void row_put(weave *w, text *out, span row, int head, size_t line)
{
    span cell, rest = span_part(row, 1, row.size >= 2 ? row.size - 2 : 0);
    int first = 1;
    text_put(out, "<tr>");
    while (cell_split(&rest, &cell)) {
        text_put(out, head ? "<th>" : "<td>");
        if (first && !head && paper_register(w, out, cell, line)) text_escape(out, cell);
        else prose_inline(w, out, cell, line);
        text_put(out, head ? "</th>" : "</td>");
        first = 0;
    }
    text_put(out, "</tr>\n");
}

static int row_is(span line)
{
    line = span_trim(line);
    return line.size > 1 && line.at[0] == '|' && line.at[line.size - 1] == '|';
}

/* A Markdown rule |---|:--| between head and body. */
static int row_is_rule(span line)
{
    size_t i;
    for (i = 0; i < line.size; i++)
        if (strchr("|-: ", line.at[i]) == NULL) return 0;
    return 1;
}

static size_t table_put(weave *w, text *out, const prose *p, size_t i)
{
    size_t n;
    int maps = span_starts(span_trim(span_from(span_trim(prose_line(p, i + 1)), 1)), "paper (");
    if (!maps) maps = span_starts(span_trim(span_from(span_trim(prose_line(p, i + 2)), 1)), "paper (");
    text_put(out, maps && !w->writing->lecture ? "<div class=\"table\" id=\"paper-equations\"><table>\n"
                                               : "<div class=\"table\"><table>\n");
    for (n = 0; row_is(prose_line(p, i + n)); n++)
        if (!row_is_rule(p->line[i + n])) row_put(w, out, span_trim(p->line[i + n]), n == 0, p->first + i + n);
    text_put(out, "</table></div>\n");
    return n;
}

/* The length of the mark of a list item: "- ", or "1. " (one or two digits). */
static size_t item_mark(span line)
{
    size_t i = span_indent(line), digits = 0;
    if (i >= BLOCK_INDENT) return 0;
    if (span_at(line, i) == '-' && span_at(line, i + 1) == ' ') return i + 2;
    while (is_digit(span_at(line, i + digits))) digits++;
    if (digits < 1 || digits > 2 || span_at(line, i + digits) != '.' || span_at(line, i + digits + 1) != ' ')
        return 0;
    return i + digits + 2;
}

/* Whether line i begins something that ends a paragraph. */
static int line_breaks(const prose *p, size_t i)
{
    span line = prose_line(p, i);
    return line.size == 0 || span_indent(line) >= BLOCK_INDENT || row_is(line) || span_starts(line, "# ") ||
           span_starts(line, "## ") || span_starts(line, "```") || span_starts(line, "[figure:") ||
           span_starts(line, "[function:") || (item_mark(line) > 0 && span_at(line, 0) == '-');
}

/* The text of lines i to i + n - 1, of which the first loses `skip` characters. */
static span lines_join(const prose *p, size_t i, size_t n, size_t skip, text *joined)
{
    size_t k;
    for (k = 0; k < n; k++) {
        if (k > 0) text_put(joined, "\n");
        text_put_span(joined, k == 0 ? span_from(p->line[i], skip) : span_trim(p->line[i + k]));
    }
    return span_of_text(joined);
}

/* An item goes on in lines that stand under its first word, also where a number of two digits has moved that as far in
   as a block would be. */
static size_t item_put(weave *w, text *out, const prose *p, size_t i)
{
    text joined = { NULL, 0, 0 };
    size_t n = 1, mark = item_mark(p->line[i]);
    while (i + n < p->count && item_mark(p->line[i + n]) == 0 &&
           (!line_breaks(p, i + n) || (mark >= BLOCK_INDENT && span_indent(p->line[i + n]) == mark)))
        n++;
    text_put(out, "<li>");
    prose_inline(w, out, lines_join(p, i, n, mark, &joined), p->first + i);
    text_put(out, "</li>\n");
    text_free(&joined);
    return n;
}

/* Items may be apart by one empty line. Numbers go on from the first. */
static size_t list_put(weave *w, text *out, const prose *p, size_t i)
{
    int dashes = p->line[i].at[span_indent(p->line[i])] == '-';
    size_t n = 0;
    if (dashes) text_put(out, "<ul>\n");
    else {
        size_t indent = span_indent(p->line[i]);
        text_put(out, "<ol start=\"");
        text_put_span(out, span_part(p->line[i], indent, item_mark(p->line[i]) - indent - 2));
        text_put(out, "\">\n");
    }
    for (;;) {
        span next = prose_line(p, i + n);
        size_t gap = next.size == 0 && n > 0 ? 1 : 0;
        next = prose_line(p, i + n + gap);
        if (item_mark(next) == 0 || (next.at[span_indent(next)] == '-') != dashes) break;
        n += gap;
        n += item_put(w, out, p, i + n);
    }
    text_put(out, dashes ? "</ul>\n" : "</ol>\n");
    return n;
}

/* [figure: file | Caption.]: the picture, or the command that makes it. */
static void figure_put(weave *w, text *out, span words, size_t line)
{
    size_t bar = span_find(words, "|");
    span name = span_trim(span_part(words, 0, bar)), caption = span_trim(span_from(words, bar + 1));
    text bytes = { NULL, 0, 0 };
    text_put(out, "<figure>\n");
    if (result_read(w, name, line, &bytes)) image_put(w, out, name, caption, &bytes, line);
    else {
        text_put(out, "<div class=\"unmade\">");
        text_escape(out, name);
        text_put(out, "<br>is drawn by <code>make paper</code></div>");
    }
    text_put(out, "\n<figcaption>");
    prose_inline(w, out, caption, line);
    text_put(out, "</figcaption>\n</figure>\n");
    text_free(&bytes);
}

/* A line in brackets, which may go on over several lines until one ends in a bracket. */
static size_t directive_put(weave *w, text *out, const prose *p, size_t i)
{
    text joined = { NULL, 0, 0 };
    size_t n = 1, line = p->first + i;
    span words;
    while (span_at(p->line[i + n - 1], p->line[i + n - 1].size - 1) != ']' && prose_line(p, i + n).size > 0) n++;
    words = lines_join(p, i, n, 0, &joined);
    if (words.at[words.size - 1] != ']') complain(w, line, "the bracket is not closed at the end of a line");
    else if (span_starts(words, "[figure:")) figure_put(w, out, span_part(words, 8, words.size - 9), line);
    else function_pull(w, out, span_trim(span_part(words, 10, words.size - 11)), line);
    text_free(&joined);
    return n;
}

static size_t paragraph_put(weave *w, text *out, const prose *p, size_t i)
{
    text joined = { NULL, 0, 0 };
    size_t n = 1;
    while (!line_breaks(p, i + n)) n++;
    text_put(out, "<p>");
    prose_inline(w, out, lines_join(p, i, n, 0, &joined), p->first + i);
    text_put(out, "</p>\n");
    text_free(&joined);
    return n;
}

static size_t piece_put(weave *w, text *out, const prose *p, size_t i)
{
    span line = p->line[i];
    if (line.size == 0) return 1;
    if (span_indent(line) >= BLOCK_INDENT) return block_put(w, out, p, i);
    if (span_starts(line, "```")) return fence_put(w, out, p, i);
    if (row_is(line)) return table_put(w, out, p, i);
    if (item_mark(line) > 0) return list_put(w, out, p, i);
    if (span_starts(line, "[figure:") || span_starts(line, "[function:")) return directive_put(w, out, p, i);
    if (line.at[0] == '#' && strchr("# ", span_at(line, 1)) != NULL && span_at(line, 1) != 0) {
        heading_put(w, out, line, p->first + i);
        return 1;
    }
    return paragraph_put(w, out, p, i);
}

static void prose_put(weave *w, text *out, const prose *p, size_t from)
{
    size_t i = from;
    while (i < p->count) i += piece_put(w, out, p, i);
}

/* ---- Pages. ---- */

/* The lines at the head of a comment up to and with its last heading. */
static size_t headings_count(const prose *p)
{
    size_t i, last = 0;
    for (i = 0; i < p->count; i++)
        if (span_starts(p->line[i], "# ")) last = i + 1;
    return last;
}

/* An entry of the interface: the declarations, up to an empty line before a preprocessor line, then the contract that
   stands above them in the header. */
static void entry_put(weave *w, text *out, prose *p, const block *code)
{
    size_t head = headings_count(p), count = p->count, last = code->first;
    const span *line = w->book.from.line;
    p->count = head;
    prose_put(w, out, p, 0);
    p->count = count;
    while (last < code->last && (line[last - 1].size > 0 || !span_starts(line[last], "#"))) last++;
    text_put(out, "<section class=\"entry\">\n");
    listing_put(w, out, code->first, last);
    text_put(out, "<div class=\"contract\">\n");
    prose_put(w, out, p, head);
    text_put(out, "</div>\n</section>\n");
    if (last < code->last) listing_put(w, out, last + 1, code->last);
}

/* The first sentence of the header, on a line of its own, is the title of the book. */
static size_t title_put(weave *w, text *out, const prose *p)
{
    size_t n;
    if (p->count == 0 || span_starts(p->line[0], "# ") || prose_line(p, 1).size > 0) return 0;
    n = span_find(p->line[0], ". ");
    heading_register(w, span_make("", 0), span_part(p->line[0], 0, n), p->first, 1);
    text_put(out, "<h1 id=\"part-1\">");
    prose_inline(w, out, span_part(p->line[0], 0, n), p->first);
    text_put(out, "</h1>\n<p class=\"back\">");
    prose_inline(w, out, span_trim(span_from(p->line[0], n + 1)), p->first);
    text_put(out, "</p>\n");
    return 1;
}

static void book_put(weave *w, text *out)
{
    size_t i;
    w->writing = &w->book;
    for (i = 0; i < w->symbol_count; i++) w->symbols[i].placed_declaration = w->symbols[i].placed_definition = 0;
    for (i = 0; i < w->block_count; i++) {
        const block *b = &w->blocks[i], *next = i + 1 < w->block_count ? b + 1 : NULL;
        prose p;
        if (!b->prose) {
            listing_put(w, out, b->first, b->last);
            continue;
        }
        p = prose_of_comment(&w->book.from, b->first, b->last);
        if (next != NULL && !next->prose && b->first < w->implementation && i > 0 &&
            span_trim(w->book.from.line[next->first - 1]).size > 0) {
            entry_put(w, out, &p, next);
            i++;
        } else prose_put(w, out, &p, i == 0 ? title_put(w, out, &p) : 0);
        free(p.line);
    }
}

static void lecture_put(weave *w, text *out, page *lecture)
{
    prose p;
    p.line = lecture->from.line;
    p.count = lecture->from.lines;
    p.first = 1;
    w->writing = lecture;
    prose_put(w, out, &p, 0);
}

static void page_style(text *out)
{
    static const char *const style[] = {
        ":root{color-scheme:light dark;--page:#fdfdfb;--ink:#1c1e21;--soft:#5d636b;--rule:#d9d9d0;--code:#f5f5f0;",
        "--link:#0b4f8a;--c:#4d6a4d;--k:#7a2f8f;--s:#8a3b12;--d:#86510a;--mark:#fdf1c7;--side:#f7f7f2;",
        "--mono:ui-monospace,'SF Mono','Cascadia Mono','DejaVu Sans Mono',Consolas,monospace}",
        "@media(prefers-color-scheme:dark){:root{--page:#17191c;--ink:#dfe1e4;--soft:#9aa1a9;--rule:#363a40;",
        "--code:#1f2226;--link:#84b9f0;--c:#92b892;--k:#cf9fe0;--s:#e0a37f;--d:#dcb36e;--mark:#4a4020;",
        "--side:#1b1d21}}*{box-sizing:border-box}html{scroll-padding-top:1.5rem;-webkit-text-size-adjust:100%}",
        "body{margin:0;background:var(--page);color:var(--ink);font:1.0625rem/1.6 Charter,'Bitstream Charter',",
        "'Iowan Old Style',Georgia,'Liberation Serif',serif;overflow-wrap:break-word}a{color:var(--link);",
        "text-decoration:none}a:hover{text-decoration:underline}a:focus-visible,pre:focus-visible,",
        "summary:focus-visible{outline:2px solid var(--link);outline-offset:2px}main{padding:1rem 1.25rem 6rem;",
        "max-width:70rem;margin:0 auto;min-width:0}main>*,.contract>*{max-width:42rem}main>pre,main>section,",
        "main>figure,main>.table,.contract>.table{max-width:60rem}h1,h2,h3,h4{line-height:1.25;font-weight:600}",
        "h1{font-size:2rem;margin:.5rem 0 1.5rem}h2{font-size:1.6rem;margin:5rem 0 1rem;padding-top:1rem;",
        "border-top:1px solid var(--rule)}h3{font-size:1.25rem;margin:3rem 0 .75rem}h4{font-size:1.05rem;",
        "margin:2rem 0 .5rem}sub,sup{line-height:0;font-size:.75em}.lecture h2{margin-top:2.5rem;border:0;",
        "padding:0}.self{color:var(--soft);margin-right:.3em}p{margin:.8rem 0}li{margin:.25rem 0}",
        "ul,ol{padding-left:1.5rem}code,pre{font-family:var(--mono);font-size:.86em}pre code{font-size:inherit}",
        "p code,li code,td code{background:var(--code);border-radius:3px;padding:.05em .15em}",
        "a code{color:var(--link)}pre{background:var(--code);border:1px solid var(--rule);border-radius:5px;",
        "font-size:.75rem;line-height:1.5;overflow-x:auto;margin:1rem 0;tab-size:4}.plain{padding:.6rem .9rem}",
        ".code{padding:.5rem 0}.code code{display:block;width:max-content;min-width:100%}",
        ".l{display:block;padding-right:1rem}.l:not(:has(.n)){padding-left:.9rem}.l:target,.l:target .n{",
        "background:var(--mark)}.n{display:inline-block;position:sticky;left:0;width:4.2em;padding-right:1em;",
        "text-align:right;background:var(--code);color:var(--soft);user-select:none;-webkit-user-select:none}",
        ".c{color:var(--c)}.k{color:var(--k)}.s{color:var(--s)}.d{color:var(--d)}.l a:not(.n){color:inherit;",
        "text-decoration:underline;text-decoration-color:var(--rule);text-underline-offset:.2em}",
        ".l a.name{color:var(--link)}.l a.name,.l b{font-weight:700}.l a:not(.n):hover{",
        "text-decoration-color:currentColor}.equation:target,tr:has(:target),.name:target,b:target{",
        "background:var(--mark)}.entry{margin:1.75rem 0;border-left:3px solid var(--rule);padding-left:1rem}",
        ".entry pre{margin:0}.contract{padding:.1rem 0 .1rem 1rem}.equation{display:flex;align-items:center;",
        "gap:1rem;margin:1rem 0 0;padding-left:1.5rem;border-radius:4px}main>.equation,.contract>.equation{",
        "width:fit-content;min-width:min(42rem,100%);max-width:min(60rem,100%)}.formula{flex:1;min-width:0;",
        "overflow:auto hidden;padding:.35rem 0}.tag{color:var(--soft);flex:none}math{font-family:'STIX Two Math',",
        "'Cambria Math','Latin Modern Math','Libertinus Math','TeX Gyre Termes Math','XITS Math',",
        "'Noto Sans Math','DejaVu Math TeX Gyre',math}munderover>:nth-child(3),mover>:nth-child(2){",
        "padding-bottom:.15em}.formula math{display:block math;width:max-content;text-align:left;margin:0}",
        "mtd{text-align:left;padding:.3em 0}mtd:first-child{text-align:right}mtd+mtd+mtd{padding-left:2em}",
        "h1+.back{margin-left:0}td .back{margin:.3rem 0 0}.back{margin:.1rem 0 1.2rem 1.5rem;font-size:.82rem;",
        "line-height:1.4;color:var(--soft)}.broken{color:#b00020}.unmade{color:var(--soft);",
        "background:var(--mark);border-radius:3px;padding:0 .3em}figure{margin:1.75rem 0;overflow-x:auto}",
        "figure>svg,figure>img{border-radius:5px;display:block;max-width:100%;height:auto}",
        "div.unmade{padding:2.5rem 1rem;",
        "text-align:center}figcaption{max-width:42rem;margin-top:.5rem;font-size:.92rem;color:var(--soft)}",
        ".table{overflow-x:auto;margin:1rem 0}table{border-collapse:collapse;font-size:.92rem;line-height:1.45}",
        "th,td{text-align:left;vertical-align:top;padding:.3rem 1rem .3rem 0;border-bottom:1px solid var(--rule)}",
        "td:first-child{white-space:nowrap}",
        "th{color:var(--soft);font-weight:600}.contents{list-style:none;padding:0}.contents .sub{",
        "padding-left:1.5rem}.contents li{margin:.1rem 0}nav{position:sticky;top:0;z-index:2;",
        "background:var(--side);border-bottom:1px solid var(--rule);font-size:.9rem;line-height:1.35;",
        "font-family:system-ui,-apple-system,'Segoe UI','Liberation Sans',sans-serif}nav summary{",
        "padding:.7rem 1.25rem;cursor:pointer;font-weight:600}nav details>div{max-height:75vh;overflow:auto;",
        "padding:0 1.25rem 1rem}nav ul{list-style:none;margin:0;padding:0}nav ul ul{padding-left:.9rem;",
        "border-left:1px solid var(--rule);margin:.1rem 0 .5rem .2rem}nav li{margin:0}nav a{display:block;",
        "padding:.16rem .4rem;color:var(--ink);border-radius:4px}nav h2{all:unset;display:block;",
        "margin:1rem 0 .3rem .4rem;color:var(--soft);font-size:.75rem;text-transform:uppercase;",
        "letter-spacing:.06em}nav a[aria-current]{background:var(--mark)}.follows li:not(.here)>ul{display:none}",
        "@media(max-width:63.99rem){html{scroll-padding-top:4rem}}",
        "@media(max-width:40rem){body{font-size:1rem}h1{font-size:1.6rem}h2{font-size:1.35rem;margin-top:3.5rem}",
        "main{padding:.5rem .9rem 4rem}pre{font-size:.72rem}.n{width:3.6em;padding-right:.7em}",
        "figure>svg{min-width:36rem}.entry{padding-left:.5rem}.contract{padding-left:.3rem}",
        ".equation{padding-left:.2rem;gap:.5rem}.back{margin-left:.2rem}",
        ".entry pre{white-space:pre-wrap;overflow-wrap:anywhere}.entry .code code{width:auto}}",
        "@media(min-width:64rem){body{display:grid;grid-template-columns:16rem minmax(0,1fr)}",
        "nav{height:100vh;overflow:auto;border-right:1px solid var(--rule);border-bottom:0;",
        "padding:1rem .5rem 2rem .75rem}nav summary{display:none}nav details>div{max-height:none;",
        "overflow:visible;padding:0}main{margin:0;padding:2rem 2rem 8rem;width:100%}}",
        "@media print{@page{margin:18mm 16mm}:root{--page:#fff;--ink:#000;--code:#fff;--rule:#bbb;--soft:#444;",
        "--link:#000;--c:#333;--k:#000;--s:#000;--d:#000;--mark:#fff}body{display:block;font-size:10pt}",
        "nav{display:none}main{padding:0;max-width:none}main>*,.contract>*,main>pre,main>section{max-width:none}",
        "h2{break-before:page;border:0;margin-top:0}.lecture h2{break-before:auto;margin-top:2rem}",
        "h1,h2,h3,h4{break-after:avoid}figure,.equation,tr{",
        "break-inside:avoid}pre{font-size:6.6pt;line-height:1.35;border:0;padding:0;overflow:visible}",
        ".entry{break-inside:avoid}.entry pre{break-after:avoid}.code code{width:auto}",
        ".l{white-space:pre-wrap;overflow-wrap:anywhere;",
        "padding:0 0 0 5.2em;text-indent:-5.2em}.l:not(:has(.n)){padding-left:1em;text-indent:0}",
        ".n{position:static;text-indent:0}.k{font-weight:700}.c{font-style:italic}.formula{overflow:visible}",
        ".formula math{font-size:.95em}p,li{orphans:3;widows:3}}"
    };
    size_t i;
    text_put(out, "<style>\n");
    for (i = 0; i < sizeof style / sizeof *style; i++) {
        text_put(out, style[i]);
        text_put(out, "\n");
    }
    text_put(out, "</style>\n");
}

/* The contents follow the reader: the last heading above the top third of the window is marked. */
static void page_script(text *out)
{
    static const char *const script[] = {
        "(function(){",
        "var nav=document.querySelector('nav'),box=nav.querySelector('details'),",
        "wide=matchMedia('(min-width:64rem)');",
        "function fit(){box.open=wide.matches}fit();wide.addEventListener('change',fit);",
        "nav.addEventListener('click',function(e){if(e.target.closest('a')&&!wide.matches)box.open=false});",
        "var list=[].slice.call(nav.querySelectorAll('a[href^=\"#\"]')).map(function(a){",
        "return{link:a,place:document.getElementById(a.hash.slice(1))}}).filter(function(x){return x.place}),",
        "at=null,due=false;",
        "nav.classList.add('follows');",
        "function follow(){due=false;var now=null,i,n;",
        "for(i=0;i<list.length;i++)",
        "if(list[i].place.getBoundingClientRect().top<Math.min(innerHeight/3,150))now=list[i];",
        "if(now===at)return;if(at)at.link.removeAttribute('aria-current');at=now;",
        "nav.querySelectorAll('.here').forEach(function(x){x.classList.remove('here')});if(!now)return;",
        "now.link.setAttribute('aria-current','location');",
        "for(n=now.link.parentNode;n&&n!==nav;n=n.parentNode)if(n.tagName==='LI')n.classList.add('here');",
        "var r=now.link.getBoundingClientRect(),s=wide.matches?nav:box.lastElementChild,t=s.getBoundingClientRect();",
        "if(r.top<t.top+40||r.bottom>t.bottom-40)s.scrollTop+=r.top-t.top-t.height/3}",
        "function soon(){if(!due){due=true;requestAnimationFrame(follow)}}",
        "addEventListener('scroll',soon,{passive:true});addEventListener('resize',soon);follow()})();"
    };
    size_t i;
    text_put(out, "<script>\n");
    for (i = 0; i < sizeof script / sizeof *script; i++) {
        text_put(out, script[i]);
        text_put(out, "\n");
    }
    text_put(out, "</script>\n");
}

static void nav_link(weave *w, text *out, const page *p, const heading *h)
{
    text_put(out, "<li><a href=\"#");
    anchor_put(out, p, h);
    text_put(out, "\">");
    if (h->number.size > 0) text_format(out, "%.*s ", (int)h->number.size, h->number.at);
    prose_inline(w, out, h->title, h->line);
    text_put(out, "</a>");
}

/* The part of the book that a chapter belongs to, by the form of its number. */
static const char *heading_part(const heading *h)
{
    char c = span_at(h->number, 0);
    if (is_digit(c)) return "Chapters";
    if (c == 'R' && is_digit(span_at(h->number, 1))) return "Reference";
    return c != 0 ? "Appendices" : "";
}

/* Headings of level 2, each with those of level 3 under it; the page's title stands above. */
static void nav_headings(weave *w, text *out, const page *p)
{
    size_t i;
    const char *part = "";
    int list = 0, under = 0;
    for (i = 0; i < p->heading_count; i++) {
        const heading *h = &p->headings[i];
        if (h->level < 2 || h->level > 3) continue;
        if (h->level == 3 && list && !under) text_put(out, "<ul>\n");
        if (h->level == 3) under = 1;
        if (h->level == 2) {
            if (under) text_put(out, "</ul>");
            if (list) text_put(out, "</li>\n");
            if (heading_part(h)[0] != 0 && strcmp(heading_part(h), part) != 0) {
                part = heading_part(h);
                text_format(out, "%s<h2>%s</h2>\n", list ? "</ul>" : "", part);
                list = 0;
            }
            if (!list) text_put(out, "<ul>\n");
            list = 1;
            under = 0;
        }
        nav_link(w, out, p, h);
        if (h->level == 3) text_put(out, "</li>\n");
    }
    if (under) text_put(out, "</ul>");
    if (list) text_put(out, "</li></ul>\n");
}

static span page_title(const page *p) { return p->heading_count > 0 ? p->headings[0].title : span_of("metro.h"); }

/* The name of a lecture's page: that of its file with another ending. */
static void page_name(const page *p, char *name, size_t room)
{
    const char *slash = strrchr(p->from.path, '/'), *file = slash != NULL ? slash + 1 : p->from.path;
    snprintf(name, room, "%.*s.html", (int)(strlen(file) - 3), file);
}

static void nav_lectures(weave *w, text *out)
{
    size_t i;
    char name[256];
    page *own = w->writing;
    if (w->lecture_count > 0) text_put(out, "<h2>Lectures</h2>\n<ul>\n");
    for (i = 0; i < w->lecture_count; i++) {
        page_name(&w->lectures[i], name, sizeof name);
        text_format(out, "<li><a href=\"%s\">", name);
        w->writing = &w->lectures[i];
        prose_inline(w, out, page_title(w->writing), 1);
        text_put(out, "</a></li>\n");
    }
    if (w->lecture_count > 0) text_put(out, "</ul>\n");
    w->writing = own;
}

static void nav_put(weave *w, text *out, const page *p)
{
    text_put(out, "<nav aria-label=\"Contents\"><details open><summary>Contents</summary><div>\n");
    if (p->lecture) text_put(out, "<ul><li><a href=\"index.html\">The book of metro.h</a></li></ul>\n");
    nav_headings(w, out, p);
    if (!p->lecture)
        text_put(out, "<h2>Index</h2>\n<ul><li><a href=\"#index-equations\">Equations</a></li>\n"
                      "<li><a href=\"#index-names\">Functions and types</a></li></ul>\n");
    nav_lectures(w, out);
    text_put(out, "</div></details></nav>\n");
}

static void equations_index(weave *w, text *out)
{
    size_t i;
    text_put(out, "<h2 id=\"index-equations\">Equations</h2>\n<div class=\"table\"><table>\n"
                  "<tr><th>Number</th><th>Equation, and the code that uses it</th></tr>\n");
    for (i = 0; i < w->equation_count; i++) {
        const equation *e = &w->equations[i];
        text_format(out, "<tr><td><a href=\"#eq-%.*s\">(%.*s)</a></td><td>", (int)e->tag.size, e->tag.at,
                    (int)e->tag.size, e->tag.at);
        text_put_span(out, span_of_text(&e->formula));
        text_put(out, "<p class=\"back\">");
        references_put(w, out, e->tag);
        text_put(out, "</p></td></tr>\n");
    }
    text_put(out, "</table></div>\n");
}

static int symbol_compare(const void *a, const void *b)
{
    const symbol *x = *(const symbol *const *)a, *y = *(const symbol *const *)b;
    size_t n = x->name.size < y->name.size ? x->name.size : y->name.size;
    int order = memcmp(x->name.at, y->name.at, n);
    return order != 0 ? order : (x->name.size > y->name.size) - (x->name.size < y->name.size);
}

static void line_link(text *out, size_t line)
{
    if (line > 0) text_format(out, "<a href=\"#L%lu\">%lu</a>", (unsigned long)line, (unsigned long)line);
}

/* Public functions and types by name. */
static void names_index(weave *w, text *out)
{
    const symbol **order = (const symbol **)memory_grow(NULL, (w->symbol_count + 1) * sizeof *order);
    size_t i, n = 0;
    for (i = 0; i < w->symbol_count; i++)
        if (w->symbols[i].declared > 0 && w->symbols[i].declared < w->implementation &&
            w->symbols[i].kind != CONSTANT)
            order[n++] = &w->symbols[i];
    qsort(order, n, sizeof *order, symbol_compare);
    text_put(out, "<h2 id=\"index-names\">Functions and types</h2>\n<div class=\"table\"><table>\n"
                  "<tr><th>Name</th><th>Contract, line</th><th>Code, line</th></tr>\n");
    for (i = 0; i < n; i++) {
        text_put(out, "<tr><td><code>");
        symbol_put(w, out, order[i]->name, 0, 0);
        text_put(out, "</code></td><td>");
        line_link(out, order[i]->declared);
        text_put(out, "</td><td>");
        line_link(out, order[i]->defined);
        text_put(out, "</td></tr>\n");
    }
    text_put(out, "</table></div>\n");
    free(order);
}

static void page_write(weave *w, page *p)
{
    text out = { NULL, 0, 0 };
    char name[256] = "index.html";
    if (p->lecture) page_name(p, name, sizeof name);
    w->writing = p;
    text_put(&out, "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n"
                   "<meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n<title>");
    text_escape(&out, page_title(p));
    text_put(&out, "</title>\n");
    page_style(&out);
    text_put(&out, p->lecture ? "</head>\n<body class=\"lecture\">\n" : "</head>\n<body>\n");
    nav_put(w, &out, p);
    text_put(&out, "<main>\n");
    if (p->lecture) lecture_put(w, &out, p);
    else {
        book_put(w, &out);
        equations_index(w, &out);
        names_index(w, &out);
    }
    text_put(&out, "</main>\n");
    page_script(&out);
    text_put(&out, "</body>\n</html>\n");
    if (w->out != NULL) file_write(w, w->out, name, &out);
    text_free(&out);
}

/* ---- Checks of the whole. ---- */

static void headings_check(weave *w)
{
    size_t i, k;
    span chapter = span_make("", 0);
    for (i = 0; i < w->book.heading_count; i++) {
        const heading *h = &w->book.headings[i];
        size_t dot = span_find(h->number, ".");
        for (k = 0; k < i; k++)
            if (h->number.size > 0 && span_equal(h->number, w->book.headings[k].number))
                complain(w, h->line, "heading %.*s stands in line %lu already", (int)h->number.size, h->number.at,
                         (unsigned long)w->book.headings[k].line);
        if (dot == h->number.size) chapter = h->number;
        else if (!span_equal(span_part(h->number, 0, dot), chapter))
            complain(w, h->line, "section %.*s stands in chapter %.*s", (int)h->number.size, h->number.at,
                     (int)chapter.size, chapter.at);
    }
}

static void equations_check(weave *w)
{
    size_t i, k;
    for (i = 0; i < w->equation_count; i++) {
        const equation *e = &w->equations[i];
        for (k = 0; k < i; k++)
            if (span_equal(e->tag, w->equations[k].tag))
                complain(w, e->line, "equation (%.*s) stands in line %lu already", (int)e->tag.size, e->tag.at,
                         (unsigned long)w->equations[k].line);
        for (k = 0; k < w->citation_count && !span_is(e->tag, w->citations[k].tag); k++) continue;
        if (k == w->citation_count) complain(w, e->line, "nothing cites eq %.*s", (int)e->tag.size, e->tag.at);
    }
}

static void paper_check(weave *w)
{
    size_t i, line = 1;
    for (i = 1; i <= PAPER_EQUATIONS; i++)
        if (w->paper_line[i] > line) line = w->paper_line[i];
    for (i = 1; i <= PAPER_EQUATIONS; i++)
        if (w->paper_line[i] == 0) complain(w, line, "no table row maps paper (%lu)", (unsigned long)i);
}

/* Takes the next entry of the contents in the first comment; *i is the line it stands in. */
static int contents_next(const weave *w, const prose *p, size_t *i, span *number, span *title)
{
    for (; *i < p->count; (*i)++) {
        size_t begin = *i;
        if (span_indent(p->line[*i]) < BLOCK_INDENT) continue;
        while (begin > 0 && (p->line[begin - 1].size == 0 || span_indent(p->line[begin - 1]) >= BLOCK_INDENT))
            begin--;
        while (p->line[begin].size == 0) begin++;
        if (contents_are(w, p, begin, block_size(p, begin)) && contents_entry(p->line[*i], number, title)) return 1;
    }
    return 0;
}

/* The contents carry the headings of the chapters in their order; those of the sections too, if they carry one. */
static void contents_compare(weave *w, const prose *p, int sections)
{
    size_t i = 0, k;
    span number, title;
    for (k = 0; k < w->book.heading_count; k++) {
        const heading *h = &w->book.headings[k];
        if (h->number.size == 0 || h->level > (sections ? 3u : 2u)) continue;
        if (!contents_next(w, p, &i, &number, &title) || !span_equal(number, h->number) ||
            !span_equal(title, h->title)) {
            complain(w, i < p->count ? p->first + i : p->first,
                     "the contents do not carry '%.*s %.*s' of line %lu here", (int)h->number.size, h->number.at,
                     (int)h->title.size, h->title.at, (unsigned long)h->line);
            return;
        }
        i++;
    }
    if (contents_next(w, p, &i, &number, &title))
        complain(w, p->first + i, "the contents carry '%.*s', which is no heading", (int)number.size, number.at);
}

static void contents_check(weave *w)
{
    prose p;
    size_t i;
    int sections = 0;
    span number, title;
    if (w->block_count == 0 || !w->blocks[0].prose) {
        complain(w, 1, "the header does not begin with a comment");
        return;
    }
    p = prose_of_comment(&w->book.from, w->blocks[0].first, w->blocks[0].last);
    for (i = 0; contents_next(w, &p, &i, &number, &title); i++)
        if (span_find(number, ".") < number.size) sections = 1;
    contents_compare(w, &p, sections);
    free(p.line);
}

/* Whether a comment ends one of the lines. */
static int lines_commented(const source *s, size_t first, size_t last)
{
    return span_find(source_lines(s, first, last), "/*") < source_lines(s, first, last).size;
}

/* The type that the lines define, or an empty span. */
static span type_in(const weave *w, size_t first, size_t last)
{
    size_t i;
    for (i = 0; i < w->symbol_count; i++)
        if (w->symbols[i].kind == TYPE && w->symbols[i].declared >= first && w->symbols[i].declared <= last)
            return w->symbols[i].name;
    return span_make("", 0);
}

/* One group of declarations, without an empty line inside. It has a contract when a comment stands right above, when
   the line itself carries one, or when it follows the type that it serves, under the comment of that type. */
static span group_check(weave *w, size_t first, size_t last, int commented, span type)
{
    const source *s = &w->book.from;
    size_t i;
    for (i = 0; i < w->symbol_count && !commented; i++) {
        const symbol *f = &w->symbols[i];
        size_t end = f->declared;
        if (f->kind != FUNCTION || f->declared < first || f->declared > last) continue;
        while (end < last && span_find(s->line[end - 1], ";") == s->line[end - 1].size) end++;
        if (lines_commented(s, f->declared, end)) continue;
        if (type.size > 0 && span_has_word(source_lines(s, f->declared, end), type)) continue;
        complain(w, f->declared, "%.*s has no contract: no comment stands right above it", (int)f->name.size,
                 f->name.at);
    }
    return commented && type_in(w, first, last).size > 0 ? type_in(w, first, last) : type;
}

static void contracts_check(weave *w)
{
    const source *s = &w->book.from;
    size_t b, first, last;
    for (b = 0; b < w->block_count && w->blocks[b].first < w->implementation; b++) {
        span type = span_make("", 0);
        if (w->blocks[b].prose) continue;
        for (first = w->blocks[b].first; first <= w->blocks[b].last; first = last + 1) {
            last = first;
            if (s->line[first - 1].size == 0) continue;
            while (last < w->blocks[b].last && s->line[last].size > 0) last++;
            type = group_check(w, first, last, first == w->blocks[b].first && b > 0, type);
        }
    }
}

/* Every function of the interface is named in a test. */
static void tests_check(weave *w, const char *folder)
{
    text all = { NULL, 0, 0 };
    size_t count, i;
    char **files = folder_list(folder, ".c", &count);
    for (i = 0; i < count; i++) {
        if (!file_read(files[i], &all)) complain(w, 1, "%s cannot be read", files[i]);
        text_put(&all, "\n");
        free(files[i]);
    }
    free(files);
    for (i = 0; i < w->symbol_count; i++) {
        const symbol *s = &w->symbols[i];
        if (s->kind == FUNCTION && s->declared > 0 && !span_has_word(span_of_text(&all), s->name))
            complain(w, s->declared, "no test in %s/*.c names %.*s", folder, (int)s->name.size, s->name.at);
    }
    text_free(&all);
}

/* What is declared is also written, and nothing else leaves the header. */
static void definitions_check(weave *w)
{
    size_t i;
    for (i = 0; i < w->symbol_count; i++) {
        const symbol *s = &w->symbols[i];
        if (s->kind == FUNCTION && s->declared > 0 && s->defined == 0)
            complain(w, s->declared, "%.*s is declared and never defined", (int)s->name.size, s->name.at);
        if (s->kind == FUNCTION && s->declared == 0 && span_starts(s->name, "metro_"))
            complain(w, s->defined, "%.*s is defined and not declared in the interface", (int)s->name.size,
                     s->name.at);
    }
}

static void book_check(weave *w, const char *tests)
{
    w->writing = &w->book;
    headings_check(w);
    equations_check(w);
    paper_check(w);
    contents_check(w);
    contracts_check(w);
    definitions_check(w);
    if (tests != NULL) tests_check(w, tests);
}

/* ---- The program. ---- */

static void lectures_read(weave *w, const char *folder)
{
    size_t count, i;
    char **files = folder_list(folder, ".md", &count);
    if (count > 0) {
        w->lectures = (page *)memory_grow(NULL, count * sizeof *w->lectures);
        memset(w->lectures, 0, count * sizeof *w->lectures);
    }
    for (i = 0; i < count; i++) {
        page *lecture = &w->lectures[w->lecture_count++];
        lecture->home = "index.html";
        lecture->lecture = 1;
        page_read(w, lecture, files[i]);
        free(files[i]);
    }
    free(files);
}

/* The first reading. */
static void weave_collect(weave *w)
{
    text nothing = { NULL, 0, 0 };
    size_t i;
    w->collecting = 1;
    book_put(w, &nothing);
    for (i = 0; i < w->lecture_count; i++) lecture_put(w, &nothing, &w->lectures[i]);
    text_free(&nothing);
    w->collecting = 0;
}

static void page_free(page *p)
{
    free(p->from.path);
    free(p->from.line);
    free(p->headings);
    text_free(&p->from.bytes);
}

static void weave_free(weave *w)
{
    size_t i;
    for (i = 0; i < w->lecture_count; i++) page_free(&w->lectures[i]);
    for (i = 0; i < w->equation_count; i++) text_free(&w->equations[i].formula);
    page_free(&w->book);
    free(w->lectures);
    free(w->blocks);
    free(w->symbols);
    free(w->equations);
    free(w->citations);
}

static int usage(void)
{
    fprintf(stderr, "usage: weave METRO_H RESULTS_DIR OUT_DIR [--tests DIR] [--lectures DIR] [--check]\n"
                    "       weave METRO_H [RESULTS_DIR OUT_DIR] --extract DIR [--lectures DIR]\n");
    return 2;
}

static void weave_run(weave *w, const char *header, const char *lectures, const char *tests)
{
    size_t i;
    w->book.home = "";
    if (!page_read(w, &w->book, header)) return;
    blocks_cut(w);
    symbols_collect(w);
    if (lectures != NULL) lectures_read(w, lectures);
    weave_collect(w);
    page_write(w, &w->book);
    for (i = 0; i < w->lecture_count; i++) page_write(w, &w->lectures[i]);
    if (w->check) book_check(w, tests);
    if (w->extract == NULL)
        printf("weave: %lu lines, %lu headings, %lu equations, %lu names, %lu lectures, %lu mistakes\n",
               (unsigned long)w->book.from.lines, (unsigned long)w->book.heading_count,
               (unsigned long)w->equation_count, (unsigned long)w->symbol_count, (unsigned long)w->lecture_count,
               (unsigned long)w->mistakes);
}

int main(int argc, char **argv)
{
    weave w;
    const char *place[3] = { NULL, NULL, NULL }, *lectures = NULL, *tests = NULL;
    int i, places = 0;
    memset(&w, 0, sizeof w);
    for (i = 1; i < argc; i++) {
        const char **option = strcmp(argv[i], "--lectures") == 0  ? &lectures
                              : strcmp(argv[i], "--tests") == 0   ? &tests
                              : strcmp(argv[i], "--extract") == 0 ? &w.extract
                                                                  : NULL;
        if (strcmp(argv[i], "--check") == 0) w.check = 1;
        else if (option != NULL && i + 1 < argc) *option = argv[++i];
        else if (option != NULL || argv[i][0] == '-' || places == 3) return usage();
        else place[places++] = argv[i];
    }
    if (places != 3 && (places != 1 || w.extract == NULL)) return usage();
    w.results = places == 3 ? place[1] : ".";
    w.out = w.extract == NULL ? place[2] : NULL;
    weave_run(&w, place[0], lectures, tests);
    weave_free(&w);
    return w.failed || (w.check && w.mistakes > 0);
}
