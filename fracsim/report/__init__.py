"""What is made of the folders of runs: pictures, sweeps, and one page that needs nothing else.

runs              a run folder as it is read
pictures          `fracsim render`: the split surface off-screen
export            `fracsim export`: surfaces for other programs
html_report       `fracsim report`
compare, pareto   sections about runs; which settings are worth their cost
content           sections, tables, plots as plain data
page, plots       sections to HTML; plots as SVG
environment_info  machine and programs, for the foot of a page

sweep, outcome      `fracsim sweep`: a run for each combination of values; how each ended
"""
