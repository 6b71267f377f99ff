"""Import of trajectories of other programs; no code of theirs is run, no pickle is loaded."""
