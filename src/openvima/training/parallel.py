"""Data-parallel training (DDP) over the processes of `torchrun`, each with the whole network.

`start_peers` starts the processes of one machine, with the environment in which `torchrun` starts them.
"""

import datetime
import os
import socket
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import dataclass
from typing import Any

import torch
import torch.distributed as dist
from torch import nn

from openvima.errors import ConfigError, PolicyError
from openvima.policies.base import usable_device

_STOP_S = 120.0  # of a busy machine
_NOTICE_S = 2.0
_NUM_NOTED = 2000  # characters


@contextmanager
def start_peers(others: int, arguments: Sequence[str]) -> Iterator[None]:
    """Start further processes, which are this one's peers within the block.

    They write nothing, since this process, the first one, fails as they do; if one fails by itself, the error
    here has a note with what it wrote last. However this one ends, they end, too: their connection is closed.

    Args:
        others: Number of further processes.
        arguments: Of the Python interpreter.
    """
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    shared = {"WORLD_SIZE": str(others + 1), "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    before = dict(os.environ)
    with ExitStack() as stack:
        logs = [stack.enter_context(tempfile.TemporaryFile()) for _ in range(others)]
        processes = [
            subprocess.Popen(
                [sys.executable, *arguments],
                env={**before, **shared, "RANK": str(rank), "LOCAL_RANK": str(rank)},
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=log,
            )
            for rank, log in enumerate(logs, start=1)
        ]
        os.environ.update(shared, RANK="0", LOCAL_RANK="0")
        try:
            yield
            for process in processes:
                process.wait(_STOP_S)
        except Exception as error:
            for rank, (process, log) in enumerate(zip(processes, logs, strict=True), start=1):
                with suppress(subprocess.TimeoutExpired):
                    if process.wait(_NOTICE_S):
                        log.seek(0)
                        written = log.read().decode(errors="replace")[-_NUM_NOTED:]
                        error.add_note(
                            f"process {rank} had ended with status {process.returncode}:\n{written}"
                        )
            raise
        finally:
            os.environ.clear()
            os.environ.update(before)
            for process in processes:
                process.kill()
                process.wait()


# Processes wait for the first one, which builds the object cache and runs rollouts.
TIMEOUT = datetime.timedelta(days=1)


@dataclass(frozen=True, slots=True)
class Parallel:
    """The processes of a run.

    Args:
        rank: Rank of this process.
        num_ranks: World size.
        device: Device of this process.
    """

    rank: int
    num_ranks: int
    device: torch.device

    @property
    def is_first(self) -> bool:
        """Whether this process writes files and reports."""
        return self.rank == 0

    def wrap(self, module: nn.Module) -> nn.Module:
        """Wrap a module for training, so that gradients are synchronized between processes."""
        if self.num_ranks == 1:
            return module
        ids = [self.device.index] if self.device.type == "cuda" else None
        # Processes may call it different numbers of times; no buffer changes in training.
        with warnings.catch_warnings():
            # Its successor does not exist in the oldest torch that is allowed.
            warnings.filterwarnings("ignore", "`broadcast_buffers` is deprecated", FutureWarning)
            return nn.parallel.DistributedDataParallel(module, device_ids=ids, broadcast_buffers=False)

    def autocast(self, precision: str) -> AbstractContextManager[Any]:
        """Return a context for mixed precision, "float32" or "bfloat16"."""
        return torch.autocast(self.device.type, torch.bfloat16, enabled=precision == "bfloat16")

    def mean(self, values: Mapping[str, float]) -> dict[str, float]:
        """Average metrics over all processes; a missing metric counts as 0."""
        if self.num_ranks == 1:
            return dict(values)
        everywhere: list[dict[str, float]] = [{}] * self.num_ranks
        dist.all_gather_object(everywhere, dict(values))
        names = {name: None for part in everywhere for name in part}
        return {name: sum(part.get(name, 0.0) for part in everywhere) / self.num_ranks for name in names}

    def part_of(self, count: int) -> range:
        """Return which of so many numbers are this process's; those of the next process follow."""
        return range(self.rank * count // self.num_ranks, (self.rank + 1) * count // self.num_ranks)

    def rows_of_all(self, rows_N: torch.Tensor) -> torch.Tensor:
        """Concatenate the rows of all processes, on their device."""
        if self.num_ranks == 1:
            return rows_N
        lengths = [0] * self.num_ranks
        dist.all_gather_object(lengths, len(rows_N))
        longest = rows_N.new_zeros(max(lengths), *rows_N.shape[1:])
        longest[: len(rows_N)] = rows_N
        parts = [torch.empty_like(longest) for _ in lengths]
        dist.all_gather(parts, longest)
        return torch.cat([part[:length] for part, length in zip(parts, lengths, strict=True)])

    def in_parts(
        self, function: Callable[[torch.Tensor], torch.Tensor], rows_N: torch.Tensor
    ) -> torch.Tensor:
        """Apply a function of rows to those of this process, and gather the results of all processes.

        Every process passes equal rows, and goes on with equal results; `average_gradients` is then due.
        """
        if self.num_ranks == 1:
            return function(rows_N)
        part = self.part_of(len(rows_N))
        return _Gathered.apply(function(rows_N[part.start : part.stop]), self, part)

    def average_gradients(self, parameters: Iterable[nn.Parameter]) -> None:
        """Average gradients over all processes."""
        if self.num_ranks == 1:
            return
        for parameter in parameters:
            if parameter.grad is not None:
                dist.all_reduce(parameter.grad)
                parameter.grad /= self.num_ranks

    def wait(self) -> None:
        """Wait for all processes."""
        if self.num_ranks > 1:
            dist.barrier()


class _Gathered(torch.autograd.Function):
    """Concatenates the rows of all processes, each of which goes on to the same loss."""

    @staticmethod
    def forward(ctx: Any, part_NX: torch.Tensor, parallel: Parallel, part: range) -> torch.Tensor:
        ctx.num_ranks, ctx.part = parallel.num_ranks, part
        return parallel.rows_of_all(part_NX)

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor, None, None]:
        # All processes have the same gradient of the whole; their parts are averaged afterwards.
        return gradients[0][ctx.part.start : ctx.part.stop] * ctx.num_ranks, None, None


ONE_PROCESS = Parallel(0, 1, torch.device("cpu"))


@contextmanager
def join_processes(device: str) -> Iterator[Parallel]:
    """Join the process group of `torchrun`, if there is one.

    Args:
        device: "auto" takes a GPU where there is one; or "cpu", "cuda", "cuda:1".

    Raises:
        ConfigError: There is no such device.
    """
    rank, num_ranks = int(os.environ.get("RANK", 0)), int(os.environ.get("WORLD_SIZE", 1))
    resolved = device
    if resolved == "auto":
        resolved = "cuda" if torch.cuda.is_available() else "cpu"
    if resolved == "cuda":
        resolved = f"cuda:{os.environ.get('LOCAL_RANK', 0)}"
    try:
        chosen = usable_device(resolved)
    except PolicyError:
        raise ConfigError(
            f"runtime.device is {device!r}; it must be auto, cpu, or a usable GPU: cuda or cuda:NUMBER."
        ) from None
    if chosen.type == "cuda":
        torch.cuda.set_device(chosen)
    if num_ranks == 1:
        yield Parallel(0, 1, chosen)
        return
    dist.init_process_group("nccl" if chosen.type == "cuda" else "gloo", timeout=TIMEOUT)
    try:
        yield Parallel(rank, num_ranks, chosen)
        dist.barrier()  # gloo aborts if one process ends earlier
    finally:
        dist.destroy_process_group()


def named_state(module: nn.Module, optimizer: torch.optim.Optimizer) -> dict[str, Any]:
    """Return the state of each parameter of a module, by its name."""
    names = {id(parameter): name for name, parameter in module.named_parameters()}
    return {names[id(parameter)]: values for parameter, values in optimizer.state.items()}


def load_named_state(module: nn.Module, optimizer: torch.optim.Optimizer, state: Mapping[str, Any]) -> None:
    """Load what `named_state` returned; the optimizer may have its parameters in another order.

    Moments get the memory format of their parameters, as the fused optimizer requires.
    """
    names = {id(parameter): name for name, parameter in module.named_parameters()}
    ordered = [p for group in optimizer.param_groups for p in group["params"]]
    values = dict[int, dict[str, torch.Tensor]]()
    for number, parameter in enumerate(ordered):
        for key, value in state.get(names[id(parameter)], {}).items():
            if value.shape == parameter.shape:  # not the step count
                value = torch.empty_like(parameter, dtype=value.dtype, device=value.device).copy_(value)
            values.setdefault(number, {})[key] = value
    optimizer.load_state_dict({**optimizer.state_dict(), "state": values})
