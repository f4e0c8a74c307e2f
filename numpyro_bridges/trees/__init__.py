"""Rooted trees: topology and names, branch lengths, data by name."""

from ._tree import Tree as Tree
