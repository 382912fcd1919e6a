"""What a scene requires (docs/method/plan.md): each function decides one component of the model.

There is one module for each part of the model, so that a new threshold for the light does not make segments anew.
"""
