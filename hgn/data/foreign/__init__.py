"""Trajectories of other programs, read without running or unpickling anything of theirs."""
