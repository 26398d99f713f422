/* What mesh.incremental_fragments reaches: nodes around others along whole edges, and the parts that they fall into. */

#include <stdbool.h>
#include <stdint.h>

typedef struct {
    const int32_t *nodes;        /* (edges, 2) */
    const uint8_t *broken;       /* (edges,) */
    const int64_t *edges, *end;  /* edges at each node, and where those of a node end */
    const uint8_t *shared;       /* (nodes,) that another rank has, too */
} Graph;

typedef struct {
    int64_t *nodes, *place;      /* what is reached, room for all nodes; where a node is among it, -1 but meanwhile */
    int64_t *part;               /* of each node that is reached, from 0 */
    int64_t *cluster;            /* of each: parts that hung together by what is reached before edges broke */
    uint8_t *goes_on;            /* (parts,) whether it has nodes of the last round or of another rank */
    int64_t *of_part;            /* (parts,) the piece of before that it is of */
} Reached;

static int64_t root(int64_t *above, int64_t n)
{
    while (above[n] != n) n = above[n] = above[above[n]];
    return n;
}

/* Roots come before what hangs on them. */
static inline void join(int64_t *above, int64_t n, int64_t m)
{
    n = root(above, n), m = root(above, m);
    if (n < m) above[m] = n;
    else above[n] = m;
}

static inline int64_t at(const Reached *all, int64_t node, int64_t *count)
{
    if (all->place[node] < 0) {
        all->nodes[*count] = node;
        all->part[*count] = all->cluster[*count] = *count;
        all->place[node] = (*count)++;
    }
    return all->place[node];
}

/* Whether no cluster has two parts that go on: to nodes of the last round, from `first` on, or to another rank. */
static bool settled(const Graph *graph, const Reached *all, int64_t first, int64_t count)
{
    int64_t *open = all->of_part; /* of each cluster, by its root */
    for (int64_t n = 0; n < count; n++) open[n] = -1;
    for (int64_t n = 0; n < count; n++) {
        if (n < first && !graph->shared[all->nodes[n]]) continue;
        int64_t part = root(all->part, n), cluster = root(all->cluster, n);
        if (open[cluster] >= 0 && open[cluster] != part) return false;
        open[cluster] = part;
    }
    return true;
}

/* Nodes around the ends of some edges (some,) that have broken, along whole edges, and their parts: as far as it takes
   until they are settled, or `far` edges. Returns how many nodes there are, and sets how many parts, and whether they are
   settled; `piece`: (nodes,) those of before. */
int64_t reached(
    const Graph *graph, const Reached *all, int64_t some, const int64_t *edges, int64_t far, const int64_t *piece,
    int64_t *parts, int64_t *done)
{
    int64_t first = 0, count = 0, *part = all->part;
    for (int64_t n = 0; n < some; n++) {
        const int32_t *ends = graph->nodes + 2 * edges[n];
        int64_t one = at(all, ends[0], &count);
        join(all->cluster, one, at(all, ends[1], &count));
    }
    int64_t last = count;
    *done = false;
    for (int64_t round = 0; round < far && !*done; round++) {
        for (int64_t n = first; n < last; n++) {
            int64_t node = all->nodes[n];
            for (int64_t j = node ? graph->end[node - 1] : 0; j < graph->end[node]; j++) {
                int64_t edge = graph->edges[j];
                if (graph->broken[edge]) continue;
                int64_t to = graph->nodes[2 * edge] == node ? graph->nodes[2 * edge + 1] : graph->nodes[2 * edge];
                int64_t other = at(all, to, &count);
                join(part, n, other);
                join(all->cluster, n, other);
            }
        }
        first = last;
        last = count;
        *done = settled(graph, all, first, count);
    }
    *parts = 0;
    for (int64_t n = 0; n < count; n++) {
        int64_t node = all->nodes[n];
        all->place[node] = -1;
        if (part[n] == n) {
            all->of_part[*parts] = piece[node];
            all->goes_on[part[n] = (*parts)++] = 0;
        } else part[n] = part[part[n]];
        if (n >= first || graph->shared[node]) all->goes_on[part[n]] = 1;
    }
    return count;
}
