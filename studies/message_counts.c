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

static long long sum(const int *values, MPI_Comm comm) {
    int size;
    long long result = 0;
    PMPI_Comm_size(comm, &size);
    for (int rank = 0; rank < size; rank++) result += values[rank];
    return result;
}

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

static void sent_to_neighbours(const int *values, MPI_Datatype type, MPI_Comm comm) {
    for (int neighbour = 0; neighbour < neighbour_count(comm); neighbour++) sent(values[neighbour], type);
}

#define SEND(name) \
    int MPI_##name(const void *b, int n, MPI_Datatype t, int to, int tag, MPI_Comm c) { \
        sent(n, t); \
        return PMPI_##name(b, n, t, to, tag, c); \
    }
#define START(name) \
    int MPI_##name(const void *b, int n, MPI_Datatype t, int to, int tag, MPI_Comm c, MPI_Request *r) { \
        sent(n, t); \
        return PMPI_##name(b, n, t, to, tag, c, r); \
    }
#define PREPARE(name) \
    int MPI_##name(const void *b, int n, MPI_Datatype t, int to, int tag, MPI_Comm c, MPI_Request *r) { \
        int error = PMPI_##name(b, n, t, to, tag, c, r); \
        if (persistent_count < MAX_REQUESTS) \
            persistent[persistent_count].request = *r, persistent[persistent_count++].bytes = bytes_of(n, t); \
        return error; \
    }
SEND(Send) SEND(Ssend) SEND(Rsend) SEND(Bsend)
START(Isend) START(Issend) START(Irsend) START(Ibsend)
PREPARE(Send_init) PREPARE(Ssend_init) PREPARE(Rsend_init)

/* the latest one counts: MPI uses requests again that were freed */
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

int MPI_Sendrecv(const void *b, int n, MPI_Datatype t, int to, int tag, void *rb, int rn, MPI_Datatype rt, int from, int rtag,
                 MPI_Comm c, MPI_Status *s) {
    sent(n, t);
    return PMPI_Sendrecv(b, n, t, to, tag, rb, rn, rt, from, rtag, c, s);
}

/* --- collective calls --- */

int MPI_Barrier(MPI_Comm c) { return gave(0, MPI_BYTE), PMPI_Barrier(c); }

int MPI_Ibarrier(MPI_Comm c, MPI_Request *r) { return gave(0, MPI_BYTE), PMPI_Ibarrier(c, r); }

int MPI_Bcast(void *b, int n, MPI_Datatype t, int root, MPI_Comm c) { return gave(n, t), PMPI_Bcast(b, n, t, root, c); }

int MPI_Allreduce(const void *b, void *r, int n, MPI_Datatype t, MPI_Op op, MPI_Comm c) {
    return gave(n, t), PMPI_Allreduce(b, r, n, t, op, c);
}

int MPI_Iallreduce(const void *b, void *r, int n, MPI_Datatype t, MPI_Op op, MPI_Comm c, MPI_Request *q) {
    return gave(n, t), PMPI_Iallreduce(b, r, n, t, op, c, q);
}

int MPI_Reduce(const void *b, void *r, int n, MPI_Datatype t, MPI_Op op, int root, MPI_Comm c) {
    return gave(n, t), PMPI_Reduce(b, r, n, t, op, root, c);
}

int MPI_Scan(const void *b, void *r, int n, MPI_Datatype t, MPI_Op op, MPI_Comm c) {
    return gave(n, t), PMPI_Scan(b, r, n, t, op, c);
}

int MPI_Exscan(const void *b, void *r, int n, MPI_Datatype t, MPI_Op op, MPI_Comm c) {
    return gave(n, t), PMPI_Exscan(b, r, n, t, op, c);
}

int MPI_Gather(const void *b, int n, MPI_Datatype t, void *r, int rn, MPI_Datatype rt, int root, MPI_Comm c) {
    return gave(n, t), PMPI_Gather(b, n, t, r, rn, rt, root, c);
}

int MPI_Gatherv(const void *b, int n, MPI_Datatype t, void *r, const int *rn, const int *at, MPI_Datatype rt, int root, MPI_Comm c) {
    return gave(n, t), PMPI_Gatherv(b, n, t, r, rn, at, rt, root, c);
}

int MPI_Allgather(const void *b, int n, MPI_Datatype t, void *r, int rn, MPI_Datatype rt, MPI_Comm c) {
    return gave(n, t), PMPI_Allgather(b, n, t, r, rn, rt, c);
}

int MPI_Allgatherv(const void *b, int n, MPI_Datatype t, void *r, const int *rn, const int *at, MPI_Datatype rt, MPI_Comm c) {
    return gave(n, t), PMPI_Allgatherv(b, n, t, r, rn, at, rt, c);
}

int MPI_Alltoall(const void *b, int n, MPI_Datatype t, void *r, int rn, MPI_Datatype rt, MPI_Comm c) {
    return gave((long long)n * rank_count(c), t), PMPI_Alltoall(b, n, t, r, rn, rt, c);
}

int MPI_Alltoallv(const void *b, const int *n, const int *from, MPI_Datatype t, void *r, const int *rn, const int *at,
                  MPI_Datatype rt, MPI_Comm c) {
    return gave(sum(n, c), t), PMPI_Alltoallv(b, n, from, t, r, rn, at, rt, c);
}

/* messages to neighbours alone */

int MPI_Neighbor_alltoall(const void *b, int n, MPI_Datatype t, void *r, int rn, MPI_Datatype rt, MPI_Comm c) {
    for (int neighbour = 0; neighbour < neighbour_count(c); neighbour++) sent(n, t);
    return PMPI_Neighbor_alltoall(b, n, t, r, rn, rt, c);
}

int MPI_Neighbor_alltoallv(const void *b, const int *n, const int *from, MPI_Datatype t, void *r, const int *rn, const int *at,
                           MPI_Datatype rt, MPI_Comm c) {
    return sent_to_neighbours(n, t, c), PMPI_Neighbor_alltoallv(b, n, from, t, r, rn, at, rt, c);
}

int MPI_Ineighbor_alltoallv(const void *b, const int *n, const int *from, MPI_Datatype t, void *r, const int *rn, const int *at,
                            MPI_Datatype rt, MPI_Comm c, MPI_Request *q) {
    return sent_to_neighbours(n, t, c), PMPI_Ineighbor_alltoallv(b, n, from, t, r, rn, at, rt, c, q);
}

int MPI_Neighbor_allgather(const void *b, int n, MPI_Datatype t, void *r, int rn, MPI_Datatype rt, MPI_Comm c) {
    for (int neighbour = 0; neighbour < neighbour_count(c); neighbour++) sent(n, t);
    return PMPI_Neighbor_allgather(b, n, t, r, rn, rt, c);
}
