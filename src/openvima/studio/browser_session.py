"""What one browser sees and does: the episode in view, and a thread that works on it."""

import logging
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import viser

from openvima.catalog.packs import load_assets
from openvima.env.config import DEFAULT_ENV_CONFIG, EnvConfig
from openvima.errors import ConfigError, OpenVimaError
from openvima.evaluation.config import DEFAULT_DEVICE
from openvima.evaluation.rollout_policies import RolloutPolicy, load_own_rollout_policy
from openvima.evaluation.session import EpisodeSession
from openvima.scene import Action, Episode
from openvima.serving.config import is_loopback
from openvima.serving.protocol import check_token
from openvima.studio.table import CAMERA_M, LOOK_AT_M, Table

_LOG = logging.getLogger(__name__)
YOU = "you"  # the policy that is none: a user acts
_PANEL_WIDTH = 400


@dataclass(frozen=True, slots=True)
class StudioConfig:
    """Settings of a studio.

    Args:
        path: Results folder or data folder that is opened first.
        policies: Policies to offer besides "openvima-small", "oracle", "random" and "you".
        record: Folder that demonstrations of users are written to; None: none are recorded.
        env_config: Settings of the environments.
        device: Where networks compute.
        trust_code: Run the code that run folders name.
        host: Interface to listen on. Any but the loopback interface needs a token.
        port: TCP port; 0 takes a free one.
        token: Word that browsers are asked for.

    Raises:
        ConfigError: The port is none, or the host is open to other machines and there is no token.
    """

    path: Path | None = None
    policies: tuple[str, ...] = ()
    record: Path | None = None
    env_config: EnvConfig = DEFAULT_ENV_CONFIG
    device: str = DEFAULT_DEVICE
    trust_code: bool = False
    host: str = "127.0.0.1"
    port: int = 0
    token: str | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        if not 0 <= self.port <= 65535:
            raise ConfigError(f"port is {self.port}; give one from 0 to 65535, 0 for a free one.")
        if self.token is None and not is_loopback(self.host):
            raise ConfigError(
                f"host is {self.host!r}, which other machines may reach; give a token with --token, or keep "
                "127.0.0.1 and reach it through a tunnel: ssh -L PORT:127.0.0.1:PORT MACHINE."
            )
        check_token(self.token)


class BrowserSession:
    """What one browser sees and does; its work runs in a thread of its own, in order.

    Panels read `current`, the episode in view, and change it by `open`, `step` and `back`, inside of
    `submit`. Functions given to `on_change` are called, in that thread, whenever it has changed.

    Args:
        client: The browser.
        config: Settings of the studio.
    """

    def __init__(self, client: viser.ClientHandle, config: StudioConfig) -> None:
        self.client, self.gui, self.config = client, client.gui, config
        self.assets = load_assets(config.env_config.assets)
        self.table = Table(client.scene, self.assets)
        self.current: EpisodeSession | None = None
        self.speed = 1.0
        self.stopped = threading.Event()  # ends animations and runs
        self._changed: list[Callable[[], None]] = []
        self._worker = ThreadPoolExecutor(1, thread_name_prefix=f"browser-{client.client_id}")
        client.camera.position, client.camera.look_at = CAMERA_M, LOOK_AT_M
        self.gui.main_panel.dock_right()
        self.gui.main_panel.set_width(_PANEL_WIDTH)
        self.tabs = self.gui.add_tab_group()

    def on_change(self, function: Callable[[], None]) -> None:
        """Call a function whenever the current episode or its state has changed."""
        self._changed.append(function)

    def submit(self, work: Callable[[], object]) -> "Future[None]":
        """Do work in this browser's thread; what it raises is shown, and the page lives on."""
        return self._worker.submit(self._reported, work)

    def interrupt(self, work: Callable[[], object]) -> "Future[None]":
        """Submit work, and end the animation or run before it."""
        self.stopped.set()

        def begin() -> None:
            self.stopped.clear()
            work()

        return self.submit(begin)

    def load_policy(self, name: str, *, temperature: float = 0.0) -> RolloutPolicy | None:
        """Load a policy for this browser alone; `YOU` gives None.

        Raises:
            OpenVimaError: There is no such policy.
        """
        if name == YOU:
            return None
        config = self.config
        return load_own_rollout_policy(
            name, device=config.device, trust_code=config.trust_code, temperature=temperature
        )

    def open(self, episode: Episode, policy: RolloutPolicy | None, *, compat: bool | None = None) -> None:
        """Start an episode, sampled or composed, and show it."""
        compat = self.config.env_config.compat if compat is None else compat
        opened = EpisodeSession(episode, policy, assets=self.assets, compat=compat)
        self.close_episode()
        self.current = opened
        self.table.show(opened.frame())
        self.changed()

    def step(self, action: Action | None = None) -> bool:
        """Take a step with an action, or the policy's, and show it; return whether there was one."""
        current = self.current
        if current is None or current.outcome is not None:
            return False
        step = current.step(action)
        if step is None:
            if error := current.propose().error:
                self.warn(str(error))
        else:
            self.table.animate(step.frames, speed=self.speed, stops=self.stopped.is_set)
        self.changed()
        return step is not None

    def back(self, num_steps: int) -> None:
        """Go back to the state after some steps."""
        if self.current is not None:
            self.current.back(num_steps)
            self.table.show(self.current.frame())
            self.changed()

    def changed(self) -> None:
        """Tell the panels that the current episode has changed."""
        for function in self._changed:
            self._reported(function)

    def warn(self, message: str, *, title: str = "That did not work") -> None:
        """Show a message over the page."""
        self.client.add_notification(title, message, auto_close_seconds=12.0, color="red")

    def close_episode(self) -> None:
        """Free the current episode."""
        if self.current is not None:
            self.current.close()
            self.current = None

    def close(self) -> None:
        """End the session: the browser has gone."""
        self.stopped.set()
        self._worker.submit(self.close_episode)
        self._worker.shutdown(wait=False)

    def _reported(self, work: Callable[[], object]) -> None:
        try:
            work()
        except OpenVimaError as error:
            self.warn(str(error))
        except Exception as error:  # a bug, or a policy's; the page lives on
            _LOG.exception("in the session of browser %s", self.client.client_id)
            self.warn(f"{type(error).__name__}: {error}")
