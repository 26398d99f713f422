"""The evidence behind the report: trials that anyone can run again, each recorded beside its results.

    python -m fracsim.studies.evidence OUT [--full] [--only GROUP]

Groups: precision (error against run time), stability (stiff and extreme cases), ladder (cost of what is not used),
growth (cost against cracks), dependence (on the mesh). `fracsim report OUT` makes the page.
"""
