"""Rooted trees: topology and names, branch lengths, data by name."""

from ._root import Root as Root
from ._schedule import schedule as schedule
from ._sweep import TreeProblem as TreeProblem
from ._tree import Tree as Tree
