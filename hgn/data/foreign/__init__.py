"""Imports trajectories of other programs without running their code or loading pickles."""
