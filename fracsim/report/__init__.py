"""Reports on finished runs, from the files in their output folders: pictures, sweeps, exports, and an HTML page.

compare       sections about runs: curves, energies, cost, references, error against run time
content       sections, tables and plots as plain data
export        `fracsim export`: split surfaces for other programs
html_report   `fracsim report`: the page on runs or on the evidence
page          sections to HTML and CSV files
pictures      `fracsim render`: pictures, sheets and films
plots         plots as SVG, and Pareto fronts
runs          files of a run, and how it ended
sweep         `fracsim sweep`: a run for each combination of values
"""
