/* What mesh.parting reaches: nodes around others along whole edges, and the parts that they fall into. */

#include <stdint.h>

typedef struct {
    const int32_t *nodes;        /* (edges, 2) */
    const uint8_t *broken;       /* (edges,) */
    const int64_t *edges, *end;  /* edges at each node, and where those of a node end */
    const uint8_t *shared;       /* (nodes,) that another rank has, too */
} Graph;

static int64_t root(int64_t *above, int64_t n)
{
    while (above[n] != n) n = above[n] = above[above[n]];
    return n;
}

/* Nodes at most `far` whole edges from the first `count` of `reached`, which has room for all; `place` (nodes,) is -1
   and is so again afterwards. `part` (reached,): of each, from 0; `goes_on` (parts,): whether it has nodes of the last
   round or of another rank. Returns how many nodes there are, and sets how many parts. */
int64_t reached(
    const Graph *graph, int64_t count, int64_t far, int64_t *reached, int64_t *place, int64_t *part, uint8_t *goes_on,
    int64_t *parts)
{
    int64_t first = 0, last = count;
    for (int64_t n = 0; n < count; n++) { place[reached[n]] = n; part[n] = n; }
    for (int64_t round = 0; round < far && first < last; round++) {
        for (int64_t n = first; n < last; n++) {
            int64_t node = reached[n];
            for (int64_t j = node ? graph->end[node - 1] : 0; j < graph->end[node]; j++) {
                int64_t edge = graph->edges[j], to;
                if (graph->broken[edge]) continue;
                to = graph->nodes[2 * edge] == node ? graph->nodes[2 * edge + 1] : graph->nodes[2 * edge];
                if (place[to] < 0) { reached[count] = to; part[count] = count; place[to] = count++; }
                int64_t one = root(part, n), other = root(part, place[to]);
                if (one < other) part[other] = one;
                else part[one] = other;
            }
        }
        first = last;
        last = count;
    }
    *parts = 0;
    for (int64_t n = 0; n < count; n++) {  /* roots come before what hangs on them */
        place[reached[n]] = -1;
        if (part[n] == n) goes_on[part[n] = (*parts)++] = 0;
        else part[n] = part[part[n]];
        if (n >= first || graph->shared[reached[n]]) goes_on[part[n]] = 1;
    }
    return count;
}
