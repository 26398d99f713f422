"""`python -m fracsim`: the command line."""

from .cli import program

program()
