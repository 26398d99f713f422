/* Counts of the messages that this process sends, by the profiling interface of MPI (MPI standard, chapter 15).
 *
 * Loaded before MPI (LD_PRELOAD). Each function counts and calls the one of MPI. `message_counts` copies the sums so far:
 * messages to one rank, their bytes, collective calls, and the bytes that this process gives to these.
 */
#include <mpi.h>

enum { MESSAGES, MESSAGE_BYTES, COLLECTIVES, COLLECTIVE_BYTES, KINDS, MAX_REQUESTS = 1 << 16 };

static long long counts[KINDS];
/* requests of persistent messages, and their bytes */
static struct { MPI_Request request; long long bytes; } persistent[MAX_REQUESTS];
static int persistent_count;

void message_counts(long long out[KINDS]) {
    for (int kind = 0; kind < KINDS; kind++) out[kind] = counts[kind];
}

static long long bytes_of(long long count, MPI_Datatype type) {
    int size = 0;
    PMPI_Type_size(type, &size);
    return count * size;
}

static void sent(long long count, MPI_Datatype type) { counts[MESSAGES]++, counts[MESSAGE_BYTES] += bytes_of(count, type); }

static void gave(long long count, MPI_Datatype type) { counts[COLLECTIVES]++, counts[COLLECTIVE_BYTES] += bytes_of(count, type); }

static int rank_count(MPI_Comm comm) {
    int size;
    PMPI_Comm_size(comm, &size);
    return size;
}

/* ranks that a process sends to in a communicator with a topology of a graph */
static int neighbour_count(MPI_Comm comm) {
    int in, out = 0, weighted, kind;
    PMPI_Topo_test(comm, &kind);
    if (kind == MPI_DIST_GRAPH) PMPI_Dist_graph_neighbors_count(comm, &in, &out, &weighted);
    return out;
}

/* Calls with counts of type int, and from MPI 4 on those with MPI_Count, which mpi4py makes there. */
#define CALL(name) MPI_##name
#define COUNTED_CALL(name) PMPI_##name
#define COUNT int
#define PLACE int
#include "message_counts_calls.h"
#undef CALL
#undef COUNTED_CALL
#undef COUNT
#undef PLACE

#if MPI_VERSION >= 4
#define CALL(name) MPI_##name##_c
#define COUNTED_CALL(name) PMPI_##name##_c
#define COUNT MPI_Count
#define PLACE MPI_Aint
#include "message_counts_calls.h"
#endif

/* --- requests of persistent messages, and barriers --- */

static void started(MPI_Request request) {
    for (int i = persistent_count - 1; i >= 0; i--)
        if (persistent[i].request == request) {
            counts[MESSAGES]++, counts[MESSAGE_BYTES] += persistent[i].bytes;
            return;
        }
}

int MPI_Start(MPI_Request *r) {
    started(*r);
    return PMPI_Start(r);
}

int MPI_Startall(int n, MPI_Request r[]) {
    for (int i = 0; i < n; i++) started(r[i]);
    return PMPI_Startall(n, r);
}

int MPI_Request_free(MPI_Request *r) {
    for (int i = persistent_count - 1; i >= 0; i--)
        if (persistent[i].request == *r) {
            persistent[i] = persistent[--persistent_count];
            break;
        }
    return PMPI_Request_free(r);
}

int MPI_Barrier(MPI_Comm c) { return gave(0, MPI_BYTE), PMPI_Barrier(c); }

int MPI_Ibarrier(MPI_Comm c, MPI_Request *r) { return gave(0, MPI_BYTE), PMPI_Ibarrier(c, r); }
