"""What a run writes, and what it watches meanwhile.

history          history.csv, and the probes
breaks           what is told of the edges that broke: figures, pieces, times and places
frame_files      a frame in all files that have frames
fields           what a frame of fields.xdmf holds
fields_file      fields.xdmf and fields.h5
surface          surface.pvd and pieces.csv: the split surface in time
checkpoint       state.h5, on any number of ranks; checkpoint_file: with its digest, and what is refused
summary          summary.json
energy_gain      energy from nowhere
inverted_cells   cells turned inside out
passing          pieces that pass through each other where nothing keeps them apart
meetings         obstacles that never met the body, or met it too fast
progress         a line on the terminal
interrupt        signals and the wall-time limit
folder           the output folder, and when a frame is due
own_files        what a run may write over or delete
same_study       what may change on a restart
writing          whole files or none, and why not
"""
