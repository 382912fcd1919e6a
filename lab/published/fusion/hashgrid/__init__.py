"""Multi-resolution hash-grid texture: levels of trilinear features and a small network (lab/docs/published.md#hash-grid).

Raw outputs are float32; the solver decides what they mean (docs/method/numerics.md#sigmoid-in-half-precision).
"""
