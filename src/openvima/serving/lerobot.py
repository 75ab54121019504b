"""LeRobot policies: a policy server that runs in LeRobot's own environment, with its own versions."""

import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from openvima.errors import ConfigError, ServerError, echo
from openvima.policies.naming import LEROBOT, SERVER_SCHEMES

SERVER_MODULE = "lerobot_env_openvima.serve"  # of plugins/lerobot
_STOP_S = 10.0


def lerobot_name(source: str) -> str:
    """Return a name for results: that of the folder or repository, or of the run that a checkpoint is in."""
    path = Path(source.removeprefix(LEROBOT))
    if path.name == "pretrained_model" and len(path.parts) > 3:  # RUN/checkpoints/STEP/pretrained_model
        path = path.parents[2]
    return path.name


@contextmanager
def lerobot_server(source: str, python: str, *, device: str = "cpu") -> Iterator[str]:
    """Serve a LeRobot policy from another Python while the block runs.

    Args:
        source: lerobot:PATH_OR_ID.
        python: The Python of an environment with LeRobot and the plugin of plugins/lerobot.
        device: Where the network computes.

    Yields:
        The server's address.

    Raises:
        ConfigError: `python` cannot be started.
        ServerError: The server did not start; the message is the last line that it wrote.
    """
    command = [
        python,
        "-m",
        SERVER_MODULE,
        source.removeprefix(LEROBOT),
        "--device",
        device,
        "--stop-with-input",
    ]
    with tempfile.TemporaryFile() as log:
        try:
            process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
                errors="replace",
            )
        except OSError as error:
            raise ConfigError(f"--python is {python!r}, which cannot be started: {error}.") from error
        with process:
            assert process.stdin is not None and process.stdout is not None  # pipes
            try:
                url = next((line.strip() for line in process.stdout if line.startswith(SERVER_SCHEMES)), None)
                if url is None:
                    log.seek(0)
                    lines = log.read().decode(errors="replace").strip().splitlines() or ["it wrote nothing"]
                    raise ServerError(
                        f"{python} cannot serve {echo(source)}: {echo(lines[-1].strip('. '))}. "
                        "plugins/lerobot/make_environment.sh makes an environment that can."
                    )
                yield url
            finally:
                with suppress(OSError):  # it also ends when its input does, should this process be killed
                    process.stdin.close()
                process.terminate()
                try:
                    process.wait(_STOP_S)
                except subprocess.TimeoutExpired:
                    process.kill()
