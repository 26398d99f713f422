"""What a run writes, and what it watches meanwhile.

history                 history.csv, and the probes
fracture_log            what is told of the edges that broke: figures, pieces, times and places
frame_files             a frame in all files that have frames
fields                  what a frame of fields.xdmf holds
fields_file             fields.xdmf and fields.h5
surface                 surface.pvd and pieces.csv: the split surface in time
checkpoint              state.h5, on any number of ranks; checkpoint_file: with its digest, and what is refused
summary                 summary.json
energy_check            energy from nowhere
inverted_cells          cells turned inside out
interpenetration_check  pieces that pass through each other where nothing keeps them apart
contact_checks          obstacles that never met the body, or met it too fast
progress                a line on the terminal
interrupt               signals and the wall-time limit
run_folder              the output folder, and when a frame is due; what may change on a restart
file_ownership          what a run may write over or delete
atomic_write            whole files or none, and why not
"""
