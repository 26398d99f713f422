"""Stiff bodies that move rigidly, are strained by blows and break (METHOD section 10; Bao et al. 2007).

relief       what a load accelerates a free body with is taken off it
free_body    the quasi-static analysis of one body, or of one piece of a broken one
pinned       B07's three pinned points, to compare with
point_loads  forces at points of a surface, handed to the nodes of the cells behind
breakable    the one mesh of all bodies: a struck piece breaks, and its pieces in turn
bodies       mass, place and motion of pieces, and of what they break into
"""
