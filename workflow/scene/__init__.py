"""What several stages read of a scene: normal form, base scene, recovered scene, emission pixels."""
