"""Hierarchical graph networks for learned particle physics."""
