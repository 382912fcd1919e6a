"""Fixtures that several unit tests share."""

import socket
from contextlib import ExitStack

import pytest


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
