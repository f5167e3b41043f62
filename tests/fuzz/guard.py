# Licensed under a 3-clause BSD style license - see LICENSE
"""What a reader may not do: touch other files, start programs, take memory or time."""

import ctypes
import os
import resource
import signal
import site
import sys
import sysconfig
from contextlib import contextmanager, suppress
from pathlib import Path

__all__ = [
    "die_with_parent",
    "install",
    "limit_memory",
    "peak",
    "reset_peak",
    "seconds_of",
    "watching",
]

_EVENTS = (
    *("os.system", "os.exec", "os.posix_spawn", "os.spawn", "os.fork", "os.forkpty"),
    *("subprocess.Popen", "pickle.find_class", "socket.connect", "socket.getaddrinfo"),
    *("urllib.Request", "os.remove", "os.rename", "os.truncate", "os.link", "os.symlink"),
    *("shutil.rmtree", "shutil.move", "webbrowser.open", "os.chmod"),
)
_LIBRARIES = tuple(
    {
        *(str(Path(path).resolve()) for path in (sys.prefix, sys.base_prefix)),
        *sysconfig.get_paths().values(),
        *site.getsitepackages(),
        str(Path(__file__).resolve().parents[2]),
        *("/proc", "/sys", "/dev", "/usr/lib", "/usr/share", "/lib", "/etc/ld.so.cache"),
    }
)
_state = {"installed": False, "folder": None, "seen": []}


def install():
    """Begin to hear of what the interpreter does; there is no way back."""
    if not _state["installed"]:
        sys.addaudithook(_hear)
        _state["installed"] = True


@contextmanager
def watching(folder):
    """Give the list of what is done that should not be, outside of a folder."""
    _state["folder"], _state["seen"] = str(Path(folder).resolve()), []
    seen = _state["seen"]
    try:
        yield seen
    finally:
        _state["folder"] = None


def _hear(event, arguments):
    if _state["folder"] is None:
        return
    if event == "open":
        _hear_open(*arguments)
    elif event in ("os.remove", "os.rename", "os.truncate"):
        if not _inside(arguments[0]):
            _state["seen"].append(f"{event} {arguments[0]!r}")
    elif event in _EVENTS:
        _state["seen"].append(f"{event} {str(arguments)[:100]}")
    elif event == "compile" and arguments[0] is not None:
        text = arguments[0]
        text = text if isinstance(text, str) else bytes(text).decode("latin-1")
        if "pwned" in text or "canary" in text:
            _state["seen"].append(f"compile {text[:100]}")


def _inside(path):
    if isinstance(path, int):
        return True
    path = os.path.abspath(os.fsdecode(path))
    return os.path.basename(path)[:6] != "canary" and path.startswith(_state["folder"])


def _hear_open(path, mode, flags):
    if path is None or isinstance(path, int) or _inside(path):
        return
    shown = os.path.abspath(os.fsdecode(path))
    writes = flags & (os.O_WRONLY | os.O_RDWR) if isinstance(flags, int) else 0
    if shown == "/dev/null" or (not writes and shown.startswith(_LIBRARIES)):
        return
    _state["seen"].append(f"open {shown} {mode}")


# ---- memory and time ---------------------------------------------------------------


def die_with_parent():
    """Let the system end this process, which may hang, when the one that made it ends."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)


def limit_memory(megabytes):
    """Let this process take so much address space more."""
    now = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    limit = now + megabytes * 2**20
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


def reset_peak():
    """Forget the largest memory so far; return what is taken now, in MB."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        pass
    return peak()


def peak():
    """Return the largest memory that was taken since, in MB."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM"):
            return int(line.split()[1]) / 1024
    return 0.0


def seconds_of(process):
    """Return the time of the processor that a process has used."""
    try:
        fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
