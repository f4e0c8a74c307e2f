# %% [markdown]
# # How fast do wings of mosquitoes evolve, and what did the wings of their ancestors look like?
#
# 126 outlines of wings, of 11 genera on a tree, as specimens of their genus: how much genera differ
# by their history, over which length scale, how much wings differ within a genus, and which
# ancestral outlines that leaves.
#
#     python examples/mosquito_tree.py            # 4 chains, some minutes on 2 cores
#     python examples/mosquito_tree.py --quick    # under a minute, to see that all runs
#
# The model and all the work are in `phylogeny.py`, which does the same for files of your own.

# %%
from phylogeny import analyse, options, prepare, settings

import numpyro_bridges as nb

arguments = settings(
    options("Wings of mosquitoes on the tree of their genera.", magnify=4.0).parse_known_args()[0]
)

# %% [markdown]
# ## The data
# Real outlines, aligned, at unit RMS radius. The tree has a published topology and lengths by
# Grafen's rule, not dates: rates are per height of the tree.

# %%
wings = nb.datasets.mosquito_wings(num_points=arguments.points)
tree = nb.datasets.mosquito_tree()
data = prepare(wings.points, wings.labels, tree)

# %% [markdown]
# ## Inference, a summary, a NetCDF file and two figures
# What to doubt: specimens are modelled as independent at every point, which real variation is not,
# and a genus is no population. Three genera have one specimen, whose error is known from the
# others'.

# %%
analyse(data, arguments, "mosquito_tree")
