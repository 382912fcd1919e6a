"""Emission: which surfaces shine, in which groups of faces, and how brightly (docs/method/light.md).

`sensor` turns photographs into radiance; `candidates` and `groups` find faces that may shine; `cache` keeps the radiance of
everything else; `environment` is the light from outside. `rows` and `problem` assemble the linear system, `gains` solves the
albedo gains of objects with it, `direct` and `sgd` solve for the radiance of the groups, `pruning` removes groups that only
reflect, and `loss` judges the solvers.
"""
