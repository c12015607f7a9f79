/* Copies of an instance's whole state, and their bytes. */
#include "internal.h"

typedef struct {
    char token[48];
    size_t doubles, steps, echoes;
} Header;

/* Pointers in `r` are those of the instance that was copied; who takes the copy back keeps its own. */
typedef struct {
    Header header;
    State s;
    run r;
    double vectors[1]; /* the run's vectors, then its history, then its echoes */
} Copy;

#define HISTORY_ROW (2 + NODES * ND)
#define ECHO_ROW 2

static size_t bytes_of(const Header *h)
{
    return sizeof(Copy) + (h->doubles + h->steps * HISTORY_ROW + h->echoes * ECHO_ROW) * sizeof(double);
}

/* Bring the run's present values to the place that they have at its beginning, where an accepted step has changed it. */
static void put_in_place(Instance *i)
{
    run *r = &i->r, first = i->r;
    place(&first, i->work);
    if (r->y == first.y)
        return;
    for (integer k = 0; k < r->n; k++)
        exchange(&r->y[k], &r->yn[k]);
    r->y = first.y;
    r->yn = first.yn;
}

static void *snapshot(Instance *i)
{
    Header header;
    memset(&header, 0, sizeof header);
    strncpy(header.token, MODEL_TOKEN, sizeof header.token - 1);
    header.doubles = i->doubles;
    header.steps = (size_t)i->r.kept;
    header.echoes = (size_t)i->r.echoes;
    Copy *copied = calloc(1, bytes_of(&header));
    if (!copied)
        return NULL;
    put_in_place(i);
    copied->header = header;
    copied->s = i->s;
    copied->r = i->r;
    double *to = copied->vectors;
    memcpy(to, i->work, i->doubles * sizeof(double));
    to += i->doubles;
    copy(to, i->r.history, i->r.kept * HISTORY_ROW);
    copy(to + i->r.kept * HISTORY_ROW, i->r.echo, i->r.echoes * ECHO_ROW);
    return copied;
}

static int restore(Instance *i, const void *given)
{
    const Copy *copied = given;
    run *r = &i->r, own = i->r;
    integer steps = (integer)copied->header.steps, echoes = (integer)copied->header.echoes;
    if (!make_room(&own.history, &own.history_room, 0, steps, HISTORY_ROW))
        return 0;
    r->history = own.history; /* the old one is gone */
    r->history_room = own.history_room;
    if (!make_room(&own.echo, &own.echo_room, 0, echoes, ECHO_ROW))
        return 0;
    i->s = copied->s;
    *r = copied->r;
    r->history = own.history;
    r->history_room = own.history_room;
    r->echo = own.echo;
    r->echo_room = own.echo_room;
    const double *from = copied->vectors;
    memcpy(i->work, from, i->doubles * sizeof(double));
    bind(i, r->sliding == NONE ? NS : r->sliding);
    from += i->doubles;
    copy(r->history, from, steps * HISTORY_ROW);
    copy(r->echo, from + steps * HISTORY_ROW, echoes * ECHO_ROW);
    return 1;
}

static size_t snapshot_size(const void *copied)
{
    return bytes_of(&((const Copy *)copied)->header);
}

/* Write the copy's bytes; 0 where there is not enough room. */
static size_t snapshot_write(const void *copied, char *bytes, size_t room)
{
    size_t size = snapshot_size(copied);
    if (room < size)
        return 0;
    memcpy(bytes, copied, size);
    return size;
}

/* The copy from its bytes; NULL where they are not of this model or are cut short. */
static void *snapshot_read(const Instance *i, const char *bytes, size_t size)
{
    Header header;
    if (size < sizeof(Copy))
        return NULL;
    memcpy(&header, bytes, sizeof header);
    header.token[sizeof header.token - 1] = 0;
    if (strcmp(header.token, MODEL_TOKEN) || header.doubles != i->doubles)
        return NULL;
    if (header.steps > size / sizeof(double) || header.echoes > size / sizeof(double) || size < bytes_of(&header))
        return NULL;
    void *copied = malloc(bytes_of(&header));
    if (copied)
        memcpy(copied, bytes, bytes_of(&header));
    return copied;
}
