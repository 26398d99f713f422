"""Output of a run, and monitors of its results.

atomic_write      replaces files as a whole or not at all
checkpoint        state.h5: writes and reads the state, on any number of ranks
checkpoint_file   format of state.h5 with its digest, and its checks
contact_checks    monitors of obstacles: gaps, closing distances, overlaps
crack_length      length or area of the cracks and position of the tip
fields_file       fields.xdmf and fields.h5
file_ownership    files that a run may overwrite or delete
fracture_log      broken edges and fragments
frame_files       the fields of a frame, and all files that have frames
history           history.csv, and the probes
interrupt         signals and the wall-time limit
lock              lock on the output folder
progress          line of progress on the terminal
result_checks     monitors of energy gain, inverted cells, interpenetration, load drop
rigid_frames      frames of rigid bodies
run_folder        output folder: checks before a run or restart, schedule of frames
step_size_checks  monitors of strain from rotation in a step, and of peaks within a step
summary           summary.json: outcome, times, memory
surface           the split surface: surface.pvd, surface/*.vtu and pieces.csv
tip_file          tips.csv: crack tips that are followed from step to step
"""
