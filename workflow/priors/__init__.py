"""Where the K material predictions of a view come from: one module a kind, chosen by `prior: {kind: ...}`.

Each has

    predict(view, settings, capture, seed) -> (K, H, W, 5) float32

albedo R G B linear, perceptual roughness, metallic, in [0, 1]; NaN where there is no value. `settings` is what stage
prior sees (`settings.prior`, `settings.source`), `capture` the normal form. A prior that reads files from outside also
has `raw_inputs(document) -> list[Path]`, called while Snakemake plans; it names what is missing. One that is a model of its own
has `describe(settings) -> dict`, which is kept as model.json.
"""
