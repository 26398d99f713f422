"""Contact with obstacles whose surface is read from a file, by ipctk.

term            the term of the balance
free, free_term a solid that moves freely; the term where some do
front           the split surface of the body before solids, with room for walls that come to light inside one
facing          barrier and friction between the body's surface and one solid; what is felt of several
beside          whether the body may be near any of them at all
led             first guesses that have passed through no solid
solid, refined  a shape that is a closed surface of triangles; triangles no longer than an edge of the body
inside          how deep closed surfaces lie in one another
"""
