"""A disk on which power is cut, calls fail and processes are killed, for tests of what the workflow leaves behind.

`Disk` stands between Python and the file system of one folder. It records every call that changes something there, and can make
one of them fail, write less than asked, or be the last one of the process. From the record, `Disk.after` builds what a power cut
may leave: content that was not flushed is kept, lost, torn or zero, each write for itself, and names that were not flushed in
their folder are kept or lost in any order. That is less than the usual file systems of Linux promise.
"""

from __future__ import annotations

import builtins
import errno
import io
import os
import random
import signal
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

HOSTILE = ("all", "none", "names", "data")
"""What is kept of that which was not flushed, besides choices by seed."""


@dataclass(frozen=True)
class Fault:
    """What happens at a call.

    Attributes:
        kind: `kill` (SIGKILL before it), `short` (half of a write, reported as such), `torn` (half of it, then the disk is full),
            `full` (ENOSPC here and at all later calls that need room), or the name of an errno.
        call: number of the call, from 0.
    """

    kind: str
    call: int


@dataclass
class _Node:
    """A file or a folder, whatever its name: `content` before the record began, `entries` name -> node of a folder."""

    content: bytes = b""
    entries: dict[str, int] | None = None


@dataclass
class Disk:
    """Records the calls that change a folder while it is `watched`.

    Attributes:
        root: the folder; what lies elsewhere passes unseen.
        fault: what shall happen, if anything.
        steps: (call, path) of every call, also those that change nothing for good, in their order.
    """

    root: Path
    fault: Fault | None = None
    steps: list[tuple[str, str]] = field(default_factory=list)
    _changes: list[tuple[Any, ...]] = field(default_factory=list)
    _nodes: list[_Node] = field(default_factory=list)
    _ends: list[int] = field(default_factory=list)  # changes that had been made before each call

    def __post_init__(self) -> None:
        self.root = Path(os.path.realpath(self.root))
        self._prefix = f"{self.root}/"
        self._now: dict[str, int] = {}  # path -> node
        self._load(str(self.root))

    def _load(self, path: str) -> int:
        """Take over what is there, as flushed."""
        number = len(self._nodes)
        self._nodes.append(_Node())
        self._now[path] = number
        if os.path.isdir(path):
            self._nodes[number].entries = {name: self._load(f"{path}/{name}") for name in sorted(os.listdir(path))}
        else:
            self._nodes[number].content = Path(path).read_bytes()
        return number

    # -- calls ----------------------------------------------------------------------------------------------------------------

    def _path(self, path: Any, dir_fd: int | None = None) -> str | None:
        """Return an absolute path below the root, or None."""
        if isinstance(path, int):
            try:
                text = os.readlink(f"/proc/self/fd/{path}")
            except OSError:
                return None
        else:
            text = os.fsdecode(path)
            if dir_fd is not None:
                text = f"{os.readlink(f'/proc/self/fd/{dir_fd}')}/{text}"
            text = os.path.abspath(text)
        return text if text == str(self.root) or text.startswith(self._prefix) else None

    def _step(self, call: str, path: str) -> str:
        """Count a call, and do to it what the fault says; returns what is left to be done to a write."""
        number = len(self.steps)
        self.steps.append((call, path.removeprefix(self._prefix)))
        self._ends.append(len(self._changes))
        fault = self.fault
        if fault is None or number < fault.call:
            return ""
        if fault.kind == "full":
            if call in ("open", "write", "mkdir", "rename", "fsync"):
                raise self._error(errno.ENOSPC, call, path)
            return ""
        if number > fault.call:
            return ""
        if fault.kind == "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        if fault.kind in ("short", "torn"):
            return fault.kind if call == "write" else ""
        raise self._error(getattr(errno, fault.kind), call, path)

    def _error(self, code: int, call: str, path: str) -> OSError:
        """Return the error as Python raises it: those of an open file have no name."""
        return OSError(code, os.strerror(code), *([] if call in ("write", "fsync") else [path]))

    def _new(self, path: str, folder: bool) -> None:
        number = len(self._nodes)
        self._nodes.append(_Node(entries={} if folder else None))
        self._now[path] = number
        parent, name = os.path.split(path)
        self._changes.append(("set", self._now[parent], name, number))

    def _gone(self, path: str) -> None:
        parent, name = os.path.split(path)
        self._changes.append(("del", self._now[parent], name))
        del self._now[path]

    def _moved(self, source: str, target: str) -> None:
        (one, name), (two, new) = os.path.split(source), os.path.split(target)
        number = self._now[source]
        self._changes.append(("move", self._now[one], name, self._now[two], new, number))
        # Another thread of a stage, which notes its memory, may write at the same time.
        inside = [path for path in list(self._now) if path == source or path.startswith(f"{source}/")]
        for path in [path for path in list(self._now) if path == target or path.startswith(f"{target}/")]:
            del self._now[path]
        for path in inside:
            self._now[target + path[len(source) :]] = self._now.pop(path)

    @contextmanager
    def watched(self) -> Iterator[Disk]:
        """Stand between Python and the file system, until the end of the block."""
        real = {name: getattr(os, name) for name in _CALLS}
        real_open = builtins.open
        patched: dict[str, Callable[..., Any]] = {
            "replace": lambda a, b, **k: self._rename(real["replace"], a, b, **k),
            "rename": lambda a, b, **k: self._rename(real["rename"], a, b, **k),
            "unlink": lambda path, **k: self._remove("unlink", real["unlink"], path, **k),
            "remove": lambda path, **k: self._remove("unlink", real["remove"], path, **k),
            "rmdir": lambda path, **k: self._remove("rmdir", real["rmdir"], path, **k),
            "mkdir": lambda path, *a, **k: self._mkdir(real["mkdir"], path, *a, **k),
            "fsync": lambda handle: self._fsync(real["fsync"], handle),
            "link": self._refuse,
            "symlink": self._refuse,
            "truncate": self._refuse,
            "sendfile": self._no_sendfile,
        }
        try:
            for name, call in patched.items():
                setattr(os, name, call)
            builtins.open = io.open = lambda file, *a, **k: self._open(real_open, file, *a, **k)  # type: ignore[assignment]
            yield self
        finally:
            for name, call in real.items():
                setattr(os, name, call)
            builtins.open = io.open = real_open

    def _refuse(self, *arguments: Any, **keywords: Any) -> None:
        raise AssertionError(f"a call that is not recorded: {arguments}")

    def _no_sendfile(self, *arguments: Any) -> None:
        raise OSError(errno.ENOTSOCK, "shutil copies with reads and writes then")

    def _rename(self, call: Callable[..., None], source: Any, target: Any, **keywords: Any) -> None:
        one, two = self._path(source), self._path(target)
        if one is None or two is None:
            return call(source, target, **keywords)
        self._step("rename", two)
        call(source, target, **keywords)
        self._moved(one, two)
        return None

    def _remove(self, name: str, call: Callable[..., None], path: Any, *, dir_fd: int | None = None) -> None:
        place = self._path(path, dir_fd)
        if place is None or place not in self._now:
            return call(path, dir_fd=dir_fd)
        self._step(name, place)
        call(path, dir_fd=dir_fd)
        self._gone(place)
        return None

    def _mkdir(self, call: Callable[..., None], path: Any, *arguments: Any, **keywords: Any) -> None:
        place = self._path(path)
        if place is None or place in self._now or os.path.dirname(place) not in self._now:
            return call(path, *arguments, **keywords)
        self._step("mkdir", place)
        call(path, *arguments, **keywords)
        self._new(place, folder=True)
        return None

    def _fsync(self, call: Callable[[int], None], handle: int) -> None:
        place = self._path(handle)
        if place is None or place not in self._now:
            return call(handle)
        self._step("fsync", place)  # the real one would take the time of a real disk
        self._changes.append(("sync", self._now[place]))
        return None

    def _open(self, call: Callable[..., Any], file: Any, mode: str = "r", buffering: int = -1, *a: Any, **keywords: Any) -> Any:
        place = self._path(file) if not isinstance(file, int) else None
        if place is None or not set(mode) & set("wxa+"):
            return call(file, mode, buffering, *a, **keywords)
        self._step("open", place)
        opener = keywords.pop("opener", None)
        raw = _Raw(self, place, mode.replace("t", "").replace("b", ""), opener)
        if opener and os.path.isdir(file):  # a file without a name, of which nothing is left
            return raw if buffering == 0 else io.BufferedRandom(raw)
        if place not in self._now:
            self._new(place, folder=False)
        elif "w" in mode:
            self._changes.append(("cut", self._now[place]))
        raw.node = self._now[place]
        if buffering == 0:
            return raw
        buffered = io.BufferedRandom(raw) if "+" in mode else io.BufferedWriter(raw)
        return buffered if "b" in mode else io.TextIOWrapper(buffered, *a, **keywords)

    # -- what a power cut leaves ----------------------------------------------------------------------------------------------

    def after(self, call: int, choice: str | random.Random) -> dict[str, bytes | None]:
        """Return path -> content (None = a folder) of what may be on disk when power is cut before a call.

        Args:
            call: number of the call; the number of `steps` = after the last one.
            choice: `all` or `none` of what was not flushed is kept, its `names` alone, its `data` alone, or chosen by chance.
        """
        changes = self._changes[: self._ends[call] if call < len(self._ends) else None]
        flushed: set[int] = set()
        kept = []
        for change in reversed(changes):
            if change[0] == "sync":
                flushed.add(change[1])
                continue
            named = change[0] in ("set", "del", "move")
            durable = change[1] in flushed or (change[0] == "move" and change[3] in flushed)
            kept.append((change, durable or _survives(choice, named)))
        contents = {number: bytearray(node.content) for number, node in enumerate(self._nodes) if node.entries is None}
        folders = {number: dict(node.entries) for number, node in enumerate(self._nodes) if node.entries is not None}
        for change, how in reversed(kept):
            if how is False:
                continue
            if change[0] == "set":
                folders[change[1]][change[2]] = change[3]
            elif change[0] == "del":
                folders[change[1]].pop(change[2], None)
            elif change[0] == "move":
                _, one, name, two, new, number = change
                if folders[one].get(name) == number:
                    del folders[one][name]
                folders[two][new] = number
            elif change[0] == "cut":
                contents[change[1]].clear()
            else:
                _, number, offset, data = change
                if isinstance(choice, random.Random) and how == "damaged":
                    data = data[: choice.randrange(len(data))] if choice.random() < 0.5 and data else bytes(len(data))
                content = contents[number]
                content.extend(bytes(max(0, offset + len(data) - len(content))))
                content[offset : offset + len(data)] = data
        out: dict[str, bytes | None] = {}
        self._spell(0, "", folders, contents, out)
        return out

    def _spell(self, number: int, path: str, folders: Any, contents: Any, out: dict[str, bytes | None]) -> None:
        for name, inner in folders[number].items():
            place = f"{path}{name}"
            if inner in folders:
                out[place] = None
                self._spell(inner, f"{place}/", folders, contents, out)
            else:
                out[place] = bytes(contents[inner])


_CALLS = ("replace", "rename", "unlink", "remove", "rmdir", "mkdir", "fsync", "link", "symlink", "truncate", "sendfile")


def _survives(choice: str | random.Random, named: bool) -> bool | str:
    if isinstance(choice, str):
        return {"all": True, "none": False, "names": named, "data": not named}[choice]
    if named:
        return choice.random() < 0.5
    return choice.choice((True, False, "damaged"))


class _Raw(io.FileIO):
    """A file whose writes are recorded."""

    def __init__(self, disk: Disk, path: str, mode: str, opener: Any):
        super().__init__(path, mode, opener=opener)
        self.disk, self.place, self.node = disk, path, None

    def write(self, data: Any) -> int:
        view = bytes(data)
        how = self.disk._step("write", self.place)
        offset = os.fstat(self.fileno()).st_size if "a" in str(self.mode) else self.tell()
        done = super().write(view[: max(1, len(view) // 2)] if how else view)
        if self.node is not None:
            self.disk._changes.append(("data", self.node, offset, view[:done]))
        if how == "torn":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return done

    def truncate(self, size: int | None = None) -> int:
        if self.node is None:
            return super().truncate(size)
        if (self.tell() if size is None else size) != 0:
            raise AssertionError("only cutting a file to nothing is recorded")
        self.disk._changes.append(("cut", self.node))
        return super().truncate(0)


def tree(folder: Path) -> dict[str, bytes | None]:
    """Return path -> content (None = a folder) of all that is in a folder."""
    return {
        path.relative_to(folder).as_posix(): None if path.is_dir() else path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if stat.S_IFMT(path.lstat().st_mode) in (stat.S_IFDIR, stat.S_IFREG)
    }


def lay_out(folder: Path, content: dict[str, bytes | None]) -> None:
    """Write what `tree` or `Disk.after` returned to an empty folder."""
    folder.mkdir(parents=True)
    for name, data in content.items():
        path = folder / name
        if data is None:
            path.mkdir(parents=True, exist_ok=True)
        else:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
