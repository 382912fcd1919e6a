"""How a command such as `python -m workflow` ends: with 0, or with one message that says what to do."""

from __future__ import annotations

import errno
import logging
import signal
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING

from iif_core.errors import InputError

if TYPE_CHECKING:  # what these import may be imported only once the threads of native libraries are set
    from workflow.runtime.job_state import JobState

INTERRUPTED = "it was interrupted; the same command continues"
CAUSES = {
    errno.ENOSPC: "the disk is full; make room (results/ of scenes that are no longer needed), then run the same command again",
    errno.EDQUOT: "your quota of the disk is used up; make room, then run the same command again",
    errno.EIO: "the disk reports an error; look at the system's log, and check with `snakemake verify` when it is repaired",
    errno.EROFS: "the disk is mounted read-only; remount it, or work in a folder on another disk",
    errno.EACCES: "not allowed for you; give yourself the right to write there",
    errno.EPERM: "not allowed for you; give yourself the right to write there",
    errno.EMFILE: "too many open files; raise the limit (`ulimit -n 4096`), then run the same command again",
    errno.ESTALE: "the network disk lost the file; run the same command again",
    errno.EINTR: "a call was interrupted; run the same command again",
    errno.EFBIG: "the file would be larger than is allowed; raise the limit (`ulimit -f unlimited`), or use another disk",
    errno.ENOMEM: "not enough memory; end other programs or give the job more, then run the same command again",
    errno.ENOTDIR: "a file is in the place of a folder; move it away, then run the same command again",
    errno.EEXIST: "a file is in the place of a folder; move it away, then run the same command again",
    errno.EISDIR: "a folder is in the place of a file; move it away, then run the same command again",
    errno.ENAMETOOLONG: "the name is too long for this disk; give the scene or its views shorter names",
}
"""What to do about errors of the machine, which no code of ours can mend."""


def of_the_machine(error: OSError) -> str:
    """Return a sentence on an error of the operating system: the file, what is wrong, and what to do."""
    from workflow.runtime.job_state import written_out

    name = error.filename2 or error.filename  # of a renaming, what was to be replaced: the other is a name of ours
    place = f"{name}: " if name else ""
    known = CAUSES.get(error.errno or 0)
    words = known or f"{error.strerror or error} (if the file should be there, please report it with the log)"
    return written_out(f"{place}{words}")


def guarded(what: str, run: Callable[[], object], state: JobState | None = None) -> int:
    """Call `run`; log an error, record it in `state`, and return the exit code."""
    code = 1
    try:
        if state:
            state.started()
        run()
        if state:
            state.done()
    except InputError as error:
        logging.getLogger("error").error("%s", error)
        reason = str(error)
    except OSError as error:
        reason = of_the_machine(error)
        logging.getLogger("error").error("%s", reason, exc_info=error.errno not in CAUSES)
    except MemoryError as error:
        reason = f"{what}: {CAUSES[errno.ENOMEM]}{f' ({error})' if str(error) else ''}"
        logging.getLogger("error").error("%s", reason)
    except Exception as error:
        logging.getLogger("error").exception("%s stopped on an unexpected error (a bug: please report it with this log)", what)
        reason = f"{type(error).__name__}: {error} (a bug: please report it with the log)"
    except KeyboardInterrupt:
        logging.getLogger("error").error("%s was interrupted", what)
        reason, code = INTERRUPTED, 128 + signal.SIGINT
    else:
        return 0
    if state:
        with suppress(OSError):  # a full disk has been reported already
            state.failed(reason)
    return code
