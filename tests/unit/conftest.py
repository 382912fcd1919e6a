"""Fixtures that several unit tests share."""

import socket

import pytest


@pytest.fixture(scope="session")
def T(llvm):
    """`iif_core.light.transport`, imported after Mitsuba's variant is set."""
    from iif_core.light import transport

    return transport


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
