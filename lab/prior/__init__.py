"""The laboratory of the learned prior: random rooms, their photographs, training, evaluation and export of the weights.

The way of the data, one module for each step:

    materials, palette, assets      what surface looks like: solid textures, and how often which material occurs
    solids, furniture, shell, lamps, rooms      geometry and light of a room that is drawn from a seed
    scan            the mesh that a capture of the room would deliver, with its errors
    cameras, sensor, photographs    poses, path tracing, response, noise, JPEG
    captures        one file per room: all that a real capture has, and the truth
    inputs          captures -> inputs of the network, by the product's own functions
    shards          crops as files, and a line about each room
    losses, training        crops -> weights
    evaluation, scenes      errors and calibration on rooms that are kept back, and on captures with truth
    residuals       errors of the weights as prior `simulated` draws them
    export, pack    weights for the product; everything that a GPU machine without a network needs

`lab/docs/prior.md` has one command for each step. No test scene and no built-in room is ever trained on.
"""
