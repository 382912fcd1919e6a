"""All settings, with what stage `weigh` reads."""

from workflow.settings import scene


class Scene(scene.SceneSettings):
    """With one of our own."""

    weight: float = 1.5
