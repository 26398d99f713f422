"""`fracsim render`: the split surface of a run off-screen, as a picture, a sheet of them or an animation.

picture_options  what a user asks of a picture
material_looks   what materials look like: bread, porcelain, ...
frames           the frames of a run, and what its study says of them
frame_geometry   a frame as the skin and the inside of a body
renderer         where a crack comes to the skin, and how far it opens there; lamps, camera, body: an array of pixels
colour_maps      which numbers colour a picture
obstacle_meshes  obstacles in a picture
floor            a floor with the shadow of what is above it
camera           where it stands, and what of the body is worth seeing
annotations      title, time, scale bar and legend on it
picture          the way in: one frame, several beside each other, or all as a film; a screen for VTK on machines that
                 have none
"""
