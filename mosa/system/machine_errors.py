"""Errors of the machine in one sentence: of a disk, a folder's rights, its memory or that of a GPU. Imports nothing heavy."""

from __future__ import annotations

import errno
import gc
import os
import re
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from json import JSONDecodeError
from pathlib import Path

from mosa.errors import MosaError
from mosa.system.caches import cache_home

DISK = {errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM, errno.ENAMETOOLONG, errno.EIO, errno.ENOTDIR,
        errno.EISDIR, errno.EFBIG, errno.EEXIST}  # fmt: skip
"""What a disk or a folder's rights refuse, which is no mistake of the program."""
NO_MEMORY = re.compile(r"can(no|')t allocate memory|out of memory|failed to allocate|failed to map segment|alloc_failed|bad_alloc|"
                       r"insufficient memory|memoryallocation|std::bad_array_new_length", re.IGNORECASE)  # fmt: skip
"""What torch, CUDA's libraries, Warp, OpenCV and the system's loader of libraries say where the machine, or a GPU, has no more:
errors of types that are also others'."""
OF_A_GPU = re.compile(
    r"cuda|cublas|cudnn|cusolver|cusparse|cufft|curand|nvrtc|nccl|\bgpu\b", re.IGNORECASE
)
LEAST = 0.5e9
"""Bytes that are free on a GPU at least, where an error of its libraries that names no memory is about something else: a library's
handle, a context or a module that finds no room says that it is not initialised, or fails to load."""
UNLOADABLE = re.compile(
    r"Failed to (load C(PU|UDA) module|find (forward|backward) kernel)|was not found in the cache"
)
"""What Warp says of a compiled kernel that it cannot use."""
LAST = Path("checkpoints", "last.ckpt")  # of a run, in its folder


def disk_message(error: OSError) -> str | None:
    """One sentence on what the disk refused; None for any other error."""
    if error.errno in (errno.EMFILE, errno.ENFILE):
        return f"{error.filename or 'a file'}: cannot be opened ({error.strerror}); allow more of them at once with ulimit -n"
    named = isinstance(error.filename, (str, os.PathLike))
    if error.errno == errno.ENOENT and named and not Path(error.filename).parent.is_dir():
        return f"{error.filename}: cannot be written or read: its folder has been removed meanwhile"
    if error.errno not in DISK and not unmade(error):
        return None
    cached = str(error.filename).startswith(cache_home())
    own = "hydra.run.dir= (of a sweep hydra.sweep.dir=) and scene.cache= (eval.py: cache=)"
    keys = "XDG_CACHE_HOME" if cached else own
    refused = f"{error.filename or 'a file'}: cannot be written or read ({error.strerror})"
    return f"{refused}; free space, or choose other folders with {keys}"


def unmade(error: OSError) -> bool:
    """Whether a folder could not be made, as in /proc, which takes none. A file that is not there to be read is a mistake of the
    program."""
    names = {frame.f_code.co_name for frame, _ in traceback.walk_tb(error.__traceback__)}
    return error.errno == errno.ENOENT and not names.isdisjoint(("mkdir", "makedirs"))


def causes(error: BaseException | None) -> Iterator[BaseException]:
    """The error, what it came from, and so on."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def gpu_memory() -> tuple[float, float] | None:
    """Bytes (free, in all) of the GPU that this process computes on; None without one, or where it does not answer any more."""
    torch = sys.modules.get("torch")
    try:
        if torch is None or not torch.cuda.is_initialized():
            return None
        return torch.cuda.mem_get_info()
    except Exception:  # a GPU that has no memory for the question either
        return None


def short_of_memory(error: BaseException) -> BaseException | None:
    """The error, or that of its causes, which says that the machine, or a GPU, has no memory left; also by what its libraries make
    of that."""
    for one in causes(error):
        if isinstance(one, MemoryError) or NO_MEMORY.search(str(one)):
            return one
    room = gpu_memory()
    if room is None or room[0] >= LEAST:
        return None
    return next((one for one in causes(error) if OF_A_GPU.search(str(one))), None)


def memory_message(error: BaseException) -> str | None:
    """One sentence on memory that there is not, of the machine or of a GPU; None for any other error."""
    if (one := short_of_memory(error)) is None:
        return None
    told = " ".join(str(one).split())[:200] or "the machine has no more"
    if not OF_A_GPU.search(told):
        return f"{told}; lower the sizes (simulation.particles, scene.scale)"
    room = gpu_memory()
    free = "" if room is None else f"; {room[0] / 1e9:.1f} of {room[1] / 1e9:.1f} GB are free"
    return (
        f"the GPU has no memory left ({told}{free}); stop what else runs there, lower simulation.particles or scene.scale, or "
        "take trainer=cpu (eval.py and others: device=cpu)"
    )


def kernels_message(error: BaseException) -> str | None:
    """One sentence on compiled kernels that a killed compiler or a full disk left damaged; None for any other error, as one of the
    compiler is: that is a mistake of the program."""
    for one in causes(error):
        frames = traceback.walk_tb(one.__traceback__)
        files = (Path(frame.f_code.co_filename) for frame, _ in frames)
        said = UNLOADABLE.search(str(one)) or isinstance(one, JSONDecodeError)
        if said and any(file.match("warp/*/context.py") for file in files):
            own = getattr(sys.modules.get("warp"), "config", None)
            place = getattr(own, "kernel_cache_dir", None) or "the folder warp of the cache"
            found = f"found some that cannot be loaded ({' '.join(str(one).split())[:120]})"
            return f"{place}: expected kernels as they were compiled, {found}; remove that folder"
    return None


def explained(error: Exception, folder: str | Path | None = None) -> str | None:
    """What ended a command, as one message, where it was the machine; None for a mistake of the program. folder: of the run, whose
    checkpoint the message names."""
    if isinstance(error, OSError) and (reason := disk_message(error)) is not None:
        return f"DataError: {reason}"
    if isinstance(error, Warning):
        said = " ".join(str(error).split())[:300]
        return f"{type(error).__name__}: {said} (a warning, which -W error or PYTHONWARNINGS makes an error)"
    if (reason := memory_message(error)) is None:
        kernels = kernels_message(error)
        return None if kernels is None else f"DataError: {kernels}"
    if folder is not None and (last := Path(folder) / LAST).is_file():
        reason += f"; the fit is kept in {last}: the same command with resume=auto goes on from it"
    return f"MemoryError: {reason}"


@contextmanager
def one_message() -> Iterator[None]:
    """What goes wrong within it by the user or the machine is one message and exit code 2."""
    try:
        yield
    except Exception as error:
        own = isinstance(error, MosaError)
        said = f"{type(error).__name__}: {error}" if own else explained(error)
        if said is None:
            raise
        print(f"\n{said}", file=sys.stderr)
        sys.exit(2)


def free_gpu_cache() -> None:
    """Frees the GPU memory that torch holds and does not use, for the next job of a sweep."""
    gc.collect()
    torch = sys.modules.get("torch")
    try:
        if torch is not None and torch.cuda.is_initialized():
            torch.cuda.empty_cache()
    except RuntimeError:  # the context itself was lost; the next job says so
        pass
