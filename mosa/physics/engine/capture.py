"""Passes that are captured as graphs once they have run. Anything else that the thread does meanwhile may break a capture."""

import warnings
from collections.abc import Callable, Hashable

import torch
import warp as wp

from mosa.physics.launching import NOTHING, ON_CPU
from mosa.system.cuda_graphs import stream_kept, uninterrupted

ATTEMPTS = 3
"""Captures in a row that may fail before there are no more: a library that sets itself up when it is first captured spoils one."""
MAX_GRAPHS = 64
"""Graphs, and passes that wait to become one, of one owner: one for each pass and time step."""

Body = Callable[[], None]


class WarpCapture:
    """Runs and captures Warp's launches alone, on a CPU too. device: torch's; of_warp: the same as Warp's."""

    def __init__(self, device: torch.device, of_warp) -> None:
        self.device, self.of_warp, self.cuda = device, of_warp, device.type == "cuda"
        self._last: tuple | None = None

    def _stream(self):
        """torch's current one, as it was last made into Warp's."""
        if not self.cuda:
            return None
        current = torch.cuda.current_stream(self.device)
        if self._last is None or self._last[0] != current:
            self._last = current, wp.stream_from_torch(current)
        return self._last[1]

    def run(self, body: Body) -> None:
        """The launches of `body`, one by one."""
        stream = self._stream()
        with NOTHING if stream is None else wp.ScopedStream(stream):
            body()

    def capture(self, body: Body) -> Body:
        """What launches them all at once. Errors: RuntimeError where they cannot be captured."""
        # on Warp's own stream: torch's default one cannot be captured
        captured = wp.ScopedCapture(device=self.of_warp, force_module_load=False)
        with NOTHING if self.cuda else ON_CPU.capturing(), uninterrupted(), captured:
            body()

        graph = captured.graph

        def replay() -> None:
            with NOTHING if self.cuda else ON_CPU:
                wp.capture_launch(graph, stream=self._stream())

        return replay


class TorchCapture:
    """As `WarpCapture`, of everything that torch and Warp do on torch's current CUDA stream."""

    def run(self, body: Body) -> None:
        body()

    def capture(self, body: Body) -> Body:
        graph = torch.cuda.CUDAGraph()
        whole = torch.cuda.graph(graph, capture_error_mode="thread_local")
        with stream_kept(), uninterrupted(), whole:
            body()
        return graph.replay


class Graphs:
    """The passes of one owner, which belong to its buffers and are dropped with them.

    failing: what the warning says, before the last error, when too many captures in a row have failed; attempts: so many, 0 for
    none at all; most: graphs, and passes that wait to become one."""

    def __init__(
        self,
        strategy: WarpCapture | TorchCapture,
        failing: str,
        attempts: int = ATTEMPTS,
        most: int = MAX_GRAPHS,
    ) -> None:
        self.strategy, self.failing, self.attempts, self.most = strategy, failing, attempts, most
        self._replays: dict[Hashable, Body] = {}
        self._warm: dict[Hashable, None] = {}  # in the order in which they ran

    def __len__(self) -> int:
        return len(self._replays)

    def play(self, name: Hashable, body: Body) -> None:
        """The launches of `body`. The first time this also compiles and loads the kernels, which a capture must not do."""
        replay = self._replays.get(name)
        if replay is not None:
            replay()
            return
        self.strategy.run(body)
        if len(self._warm) > self.most:
            self.forget()
        self._warm[name] = None

    def waits(self, name: Hashable) -> bool:
        """Whether a pass has run and is no graph yet, but may be."""
        return self.attempts > 0 and name in self._warm and name not in self._replays

    def waiting(self) -> list[Hashable]:
        return [name for name in self._warm if self.waits(name)]

    def capture(self, name: Hashable, body: Body) -> bool:
        """Whether `body` is now a graph; a failure says nothing of its launches themselves."""
        try:
            self._replays[name] = self.strategy.capture(body)
        except RuntimeError as error:
            self.attempts -= 1
            if not self.attempts:
                warnings.warn(f"{self.failing}: {error}", stacklevel=2)
            return False
        self.attempts = ATTEMPTS
        return True

    def drop(self) -> None:
        """Drop the graphs, which hold something that is another now; the passes may be captured again at once."""
        self._replays.clear()

    def forget(self) -> None:
        """Drop the graphs; each pass has to run again first."""
        self._replays.clear()
        self._warm.clear()
