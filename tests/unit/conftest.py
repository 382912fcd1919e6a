"""Fixtures that several unit tests share."""

import socket
from contextlib import ExitStack
from types import SimpleNamespace

import pytest


@pytest.fixture(scope="session")
def T(llvm):
    """Public names of the modules of `iif_core.light.transport`, imported after Mitsuba's variant is set."""
    from iif_core.light.transport import cache, emitters, geometry, materials, matrix, render, scene, shading
    from tests.oracles import face_materials

    modules = (cache, emitters, face_materials, geometry, materials, matrix, render, scene, shading)
    return SimpleNamespace(**{name: value for module in modules for name, value in vars(module).items() if name[0] != "_"})


@pytest.fixture(scope="session")
def room(T):
    """The furnished room of tests/unit/transport_rooms.py."""
    from tests.unit.transport_rooms import Room

    return Room(T)


@pytest.fixture
def offline(monkeypatch):
    """Whoever reaches for a network fails."""

    def refuse(*_):
        raise AssertionError("tried to reach a network")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    monkeypatch.setattr(socket, "getaddrinfo", refuse)


@pytest.fixture
def opened(page_for):
    """`opened(path, ...)`: a page, with what it said and asked for in `page.seen`."""
    with ExitStack() as stack:

        def open_page(*arguments, **options):
            seen = stack.enter_context(page_for(*arguments, **options))
            seen.page.seen = seen
            return seen.page

        yield open_page
