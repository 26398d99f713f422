"""`fracsim render`: the split surface of a run off-screen, as a picture, a sheet of them or an animation.

look        what a user asks of a picture
skins       what materials look like: bread, porcelain, ...
shots       the frames of a run, and what its study says of them
body        a frame as the skin and the inside of a body
rims        where a crack comes to the skin, and how far it opens there
colouring   which numbers colour a picture
obstacles   obstacles in a picture
floor       a floor with the shadow of what is above it
camera      where it stands, and what of the body is worth seeing
stage       lamps, camera, body: an array of pixels
lettering   title, time, scale bar and legend on it
picture     the way in: one frame, several beside each other, or all as a film
screen      a screen for VTK on machines that have none
"""
