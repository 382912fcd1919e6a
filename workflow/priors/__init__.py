"""Sources of the K material predictions of a view: one plug-in module per kind, chosen by `prior: {kind: ...}`.

A plug-in is a module `workflow/priors/<kind>.py` with the function

    predict(view, settings, capture, seed) -> (K, H, W, 5) float32

It returns linear albedo R G B, perceptual roughness and metallic in [0, 1], and NaN where there is no value. `settings` are the
sections that stage prior reads (`prior` and `source`), and `capture` is the normal form. Two functions are optional:

    raw_inputs(document) -> list[Path]   files from outside that it reads; called while Snakemake plans, refuses missing files
    describe(settings) -> dict           facts about a learned model, written to model.json
"""
