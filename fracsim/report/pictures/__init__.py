"""Pictures of runs (`fracsim render`), drawn off-screen: a frame, a sheet of frames, or a film.

annotations       title, time, scale bar and legend
camera            part of the body to show, and position of the camera
colour_maps       arrays that colour a picture, their range and colour map
frames            files of the frames of a run, and their geometry
picture           writes pictures, sheets and films
picture_options   options of a picture, and looks of materials
renderer          lights and body, drawn to pixels
shadows           shadows of the main light, from depth images
surroundings      obstacles and floor
"""
