/* Copies of an instance's whole state, and their bytes. */
#include "internal.h"

typedef struct {
    char token[48];
    size_t state, steps, echoes;
} Header;

typedef struct {
    Header header;
    State s;
    double tables[1]; /* history, then echoes */
} Copy;

static size_t doubles(const Header *h) { return h->steps * HISTORY_ROW + h->echoes * 2; }

static size_t bytes_of(const Header *h) { return sizeof(Copy) + doubles(h) * sizeof(double); }

void *snapshot(const Instance *i) {
    Header header;
    memset(&header, 0, sizeof header);
    strncpy(header.token, MODEL_TOKEN, sizeof header.token - 1);
    header.state = sizeof(State);
    header.steps = i->s.steps;
    header.echoes = i->s.echoes;
    Copy *copy = calloc(1, bytes_of(&header));
    if (!copy) return NULL;
    copy->header = header;
    copy->s = i->s;
    size_t steps = i->s.steps * HISTORY_ROW;
    if (steps) memcpy(copy->tables, i->history, steps * sizeof(double));
    if (i->s.echoes) memcpy(copy->tables + steps, i->echo, i->s.echoes * 2 * sizeof(double));
    return copy;
}

int restore(Instance *i, const void *given) {
    const Copy *copy = given;
    size_t steps = copy->header.steps * HISTORY_ROW, echoes = copy->header.echoes * 2;
    if (copy->header.steps > i->history_room) {
        double *larger = realloc(i->history, steps * sizeof(double));
        if (!larger) return 0;
        i->history = larger;
        i->history_room = copy->header.steps;
    }
    if (copy->header.echoes > i->echo_room) {
        double *larger = realloc(i->echo, echoes * sizeof(double));
        if (!larger) return 0;
        i->echo = larger;
        i->echo_room = copy->header.echoes;
    }
    if (steps) memcpy(i->history, copy->tables, steps * sizeof(double));
    if (echoes) memcpy(i->echo, copy->tables + steps, echoes * sizeof(double));
    i->s = copy->s;
    return 1;
}

size_t snapshot_size(const void *copy) { return bytes_of(&((const Copy *)copy)->header); }

/* Writes the copy's bytes; 0 where there is not enough room. */
size_t snapshot_write(const void *copy, char *bytes, size_t room) {
    size_t size = snapshot_size(copy);
    if (room < size) return 0;
    memcpy(bytes, copy, size);
    return size;
}

/* The copy from its bytes; NULL where they are not of this model or are cut short. */
void *snapshot_read(const char *bytes, size_t size) {
    Header header;
    if (size < sizeof(Copy)) return NULL;
    memcpy(&header, bytes, sizeof header);
    header.token[sizeof header.token - 1] = 0;
    if (strcmp(header.token, MODEL_TOKEN) || header.state != sizeof(State)) return NULL;
    if (header.steps > size / sizeof(double) || header.echoes > size / sizeof(double) || size < bytes_of(&header)) return NULL;
    Copy *copy = malloc(bytes_of(&header));
    if (copy) memcpy(copy, bytes, bytes_of(&header));
    return copy;
}
