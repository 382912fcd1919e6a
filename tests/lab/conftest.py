"""A small generated capture that the tests of the laboratory share."""

from __future__ import annotations

import pytest


@pytest.fixture(scope="session")
def room():
    """A random room without assets."""
    from lab.prior import rooms

    return rooms.build(11)


@pytest.fixture(scope="session")
def capture(llvm, room):
    """Three photographs of 48 x 48 pixels of it, few paths, no denoiser."""
    from lab.prior import photographs

    return photographs.photograph(room, 11, photographs.Session(views=3, size=48, samples=4))
