"""room.html: one page to walk through the recovered room and to switch its lamps (docs/guide/room.md)."""
