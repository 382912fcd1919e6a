"""Fusion of K inconsistent predictions per view into one base texture on the surface (docs/method/fusion.md).

`problem` defines what every solver reads and returns. `direct` is the default solver (alternating closed forms), `sgd` the
paper's optimiser on cells or on the texture of `hashgrid`, and `reference_loss` judges either by the paper's loss.
"""
