"""Attacks: what a run may meet and must outlive, or refuse with a message (`make attack`; no part of `make test`).

    kills         SIGKILL at random moments, of mpirun and of single processes; then a restart to the same result
    signals       those that a run heeds; then the same
    disks         file systems that are full; then room, and the same
    checkpoints   damaged ones: exit 2 with the name of the file, and a folder that stays as it is
    studies       values, keys and bytes of studies changed at random: a result or a message, in time
    meshes        the same of mesh files of all formats
    links         links, pipes and folders in the place of files that a run writes: nothing else is written
    pairs         two runs in one folder: one of them ends with a message

Each trial is made from its kind, its number and a seed alone: `make attack seed=1 only=studies:17` repeats one.
"""
