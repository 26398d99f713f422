"""Trials behind the report of the evidence, which anyone can run again; each is recorded beside its results.

    python -m fracsim.studies.evidence OUT [--full] [--only GROUP]

Groups: precision (error against run time), peers (other programs), stability (stiff and extreme cases), ladder (cost of
features), growth (cost against the number of cracks), rows (the paper's table), dependence (on the mesh), experiments
(measured and published loads). `fracsim report OUT` makes the page.
"""
