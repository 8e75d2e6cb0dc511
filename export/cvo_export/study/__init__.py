"""Studies: grids of runs, the engines that run them, and their reports."""
