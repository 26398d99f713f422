/* Calls of MPI that send, for one type of counts (message_counts.c): CALL and COUNTED_CALL name the functions of MPI and of
 * its profiling interface, COUNT and PLACE are the types of counts and of displacements.
 */

#define SEND(name) \
    int CALL(name)(const void *b, COUNT n, MPI_Datatype t, int to, int tag, MPI_Comm c) { \
        sent(n, t); \
        return COUNTED_CALL(name)(b, n, t, to, tag, c); \
    }
#define START(name) \
    int CALL(name)(const void *b, COUNT n, MPI_Datatype t, int to, int tag, MPI_Comm c, MPI_Request *r) { \
        sent(n, t); \
        return COUNTED_CALL(name)(b, n, t, to, tag, c, r); \
    }
#define PREPARE(name) \
    int CALL(name)(const void *b, COUNT n, MPI_Datatype t, int to, int tag, MPI_Comm c, MPI_Request *r) { \
        int error = COUNTED_CALL(name)(b, n, t, to, tag, c, r); \
        if (persistent_count == MAX_REQUESTS) PMPI_Abort(c, 1); /* what follows would not be counted */ \
        persistent[persistent_count].request = *r, persistent[persistent_count++].bytes = bytes_of(n, t); \
        return error; \
    }
SEND(Send) SEND(Ssend) SEND(Rsend) SEND(Bsend)
START(Isend) START(Issend) START(Irsend) START(Ibsend)
PREPARE(Send_init) PREPARE(Ssend_init) PREPARE(Rsend_init)
#undef SEND
#undef START
#undef PREPARE

int CALL(Sendrecv)(const void *b, COUNT n, MPI_Datatype t, int to, int tag, void *rb, COUNT rn, MPI_Datatype rt, int from,
                   int rtag, MPI_Comm c, MPI_Status *s) {
    sent(n, t);
    return COUNTED_CALL(Sendrecv)(b, n, t, to, tag, rb, rn, rt, from, rtag, c, s);
}

/* --- collective calls --- */

int CALL(Bcast)(void *b, COUNT n, MPI_Datatype t, int root, MPI_Comm c) {
    return gave(n, t), COUNTED_CALL(Bcast)(b, n, t, root, c);
}

int CALL(Allreduce)(const void *b, void *r, COUNT n, MPI_Datatype t, MPI_Op op, MPI_Comm c) {
    return gave(n, t), COUNTED_CALL(Allreduce)(b, r, n, t, op, c);
}

int CALL(Iallreduce)(const void *b, void *r, COUNT n, MPI_Datatype t, MPI_Op op, MPI_Comm c, MPI_Request *q) {
    return gave(n, t), COUNTED_CALL(Iallreduce)(b, r, n, t, op, c, q);
}

int CALL(Reduce)(const void *b, void *r, COUNT n, MPI_Datatype t, MPI_Op op, int root, MPI_Comm c) {
    return gave(n, t), COUNTED_CALL(Reduce)(b, r, n, t, op, root, c);
}

int CALL(Scan)(const void *b, void *r, COUNT n, MPI_Datatype t, MPI_Op op, MPI_Comm c) {
    return gave(n, t), COUNTED_CALL(Scan)(b, r, n, t, op, c);
}

int CALL(Exscan)(const void *b, void *r, COUNT n, MPI_Datatype t, MPI_Op op, MPI_Comm c) {
    return gave(n, t), COUNTED_CALL(Exscan)(b, r, n, t, op, c);
}

int CALL(Gather)(const void *b, COUNT n, MPI_Datatype t, void *r, COUNT rn, MPI_Datatype rt, int root, MPI_Comm c) {
    return gave(n, t), COUNTED_CALL(Gather)(b, n, t, r, rn, rt, root, c);
}

int CALL(Gatherv)(const void *b, COUNT n, MPI_Datatype t, void *r, const COUNT *rn, const PLACE *at, MPI_Datatype rt, int root,
                  MPI_Comm c) {
    return gave(n, t), COUNTED_CALL(Gatherv)(b, n, t, r, rn, at, rt, root, c);
}

int CALL(Allgather)(const void *b, COUNT n, MPI_Datatype t, void *r, COUNT rn, MPI_Datatype rt, MPI_Comm c) {
    return gave(n, t), COUNTED_CALL(Allgather)(b, n, t, r, rn, rt, c);
}

int CALL(Allgatherv)(const void *b, COUNT n, MPI_Datatype t, void *r, const COUNT *rn, const PLACE *at, MPI_Datatype rt,
                     MPI_Comm c) {
    return gave(n, t), COUNTED_CALL(Allgatherv)(b, n, t, r, rn, at, rt, c);
}

int CALL(Alltoall)(const void *b, COUNT n, MPI_Datatype t, void *r, COUNT rn, MPI_Datatype rt, MPI_Comm c) {
    return gave((long long)n * rank_count(c), t), COUNTED_CALL(Alltoall)(b, n, t, r, rn, rt, c);
}

int CALL(Alltoallv)(const void *b, const COUNT *n, const PLACE *from, MPI_Datatype t, void *r, const COUNT *rn, const PLACE *at,
                    MPI_Datatype rt, MPI_Comm c) {
    long long all = 0;
    for (int rank = 0; rank < rank_count(c); rank++) all += n[rank];
    return gave(all, t), COUNTED_CALL(Alltoallv)(b, n, from, t, r, rn, at, rt, c);
}

/* --- messages to neighbours alone --- */

int CALL(Neighbor_alltoall)(const void *b, COUNT n, MPI_Datatype t, void *r, COUNT rn, MPI_Datatype rt, MPI_Comm c) {
    for (int neighbour = 0; neighbour < neighbour_count(c); neighbour++) sent(n, t);
    return COUNTED_CALL(Neighbor_alltoall)(b, n, t, r, rn, rt, c);
}

int CALL(Neighbor_alltoallv)(const void *b, const COUNT *n, const PLACE *from, MPI_Datatype t, void *r, const COUNT *rn,
                             const PLACE *at, MPI_Datatype rt, MPI_Comm c) {
    for (int neighbour = 0; neighbour < neighbour_count(c); neighbour++) sent(n[neighbour], t);
    return COUNTED_CALL(Neighbor_alltoallv)(b, n, from, t, r, rn, at, rt, c);
}

int CALL(Ineighbor_alltoallv)(const void *b, const COUNT *n, const PLACE *from, MPI_Datatype t, void *r, const COUNT *rn,
                              const PLACE *at, MPI_Datatype rt, MPI_Comm c, MPI_Request *q) {
    for (int neighbour = 0; neighbour < neighbour_count(c); neighbour++) sent(n[neighbour], t);
    return COUNTED_CALL(Ineighbor_alltoallv)(b, n, from, t, r, rn, at, rt, c, q);
}

int CALL(Neighbor_allgather)(const void *b, COUNT n, MPI_Datatype t, void *r, COUNT rn, MPI_Datatype rt, MPI_Comm c) {
    for (int neighbour = 0; neighbour < neighbour_count(c); neighbour++) sent(n, t);
    return COUNTED_CALL(Neighbor_allgather)(b, n, t, r, rn, rt, c);
}
