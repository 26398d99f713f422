"""The report: what run folders and evidence hold, as one page that needs nothing else."""
