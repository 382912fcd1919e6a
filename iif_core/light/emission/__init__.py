"""Emission: which surfaces shine, in which groups of faces, and how brightly (docs/method/light.md).

`candidates` and `groups` find faces that may shine, `rows` and `problem` assemble the linear system, `gains` solves the albedo
gains of objects with it, `direct` and `sgd` solve for the radiance of the groups, and `pruning` removes those that only reflect.
"""
