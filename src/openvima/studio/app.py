"""The studio's server: every browser gets a session of its own, with its own episodes and scene."""

import rich
import viser
from viser.infra import ClientId

from openvima.catalog.packs import load_assets
from openvima.serving.server import check_can_listen, is_own_page
from openvima.studio.browse_panel import BrowsePanel
from openvima.studio.browser_session import BrowserSession, StudioConfig
from openvima.studio.compose_panel import ComposePanel
from openvima.studio.play_panel import PlayPanel, UserPanel, WhyPanel

HOST = "127.0.0.1"  # who reaches the studio can run code: another machine needs a tunnel
PANELS = (PlayPanel, WhyPanel, ComposePanel, UserPanel, BrowsePanel)  # in the order of their tabs


class Studio:
    """The server; `close` ends it.

    Args:
        config: Settings.

    Raises:
        ConfigError: The address cannot be listened on.
    """

    def __init__(self, config: StudioConfig) -> None:
        self.config = config
        load_assets(config.env_config.assets)  # fails now rather than in a browser
        check_can_listen(HOST, config.port)
        rich.get_console().quiet = True  # viser prints addresses of its own
        self._server = _Server(HOST, config.port, label="openvima studio", verbose=False)
        self._server.gui.configure_theme(show_logo=False, show_share_button=False)
        self.sessions: dict[int, BrowserSession] = {}
        self._server.on_client_connect(self._connected)
        self._server.on_client_disconnect(self._gone)

    @property
    def url(self) -> str:
        """The address to open in a browser."""
        return f"http://{HOST}:{self._server.get_port()}"

    def close(self) -> None:
        """End all sessions and the server."""
        for session in [*self.sessions.values()]:
            session.close()
        self.sessions.clear()
        self._server.stop()

    def _connected(self, client: viser.ClientHandle) -> None:
        if not self._server.serves(client.client_id):
            client.add_notification("No entry", "Open the address that openvima studio printed.", color="red")
            return
        session = self.sessions[client.client_id] = BrowserSession(client, self.config)
        first = () if self.config.path is None else (BrowsePanel,)
        panels = [panel(session) for panel in dict.fromkeys((*first, *PANELS))]
        if isinstance(panels[0], BrowsePanel):
            session.submit(panels[0].open)

    def _gone(self, client: viser.ClientHandle) -> None:
        session = self.sessions.pop(client.client_id, None)
        if session is not None:
            session.close()


class _Server(viser.ViserServer):
    """A server that knows who connects, and offers no tunnel to other machines."""

    def request_share_url(self, verbose: bool = True) -> None:
        """Refuse: the studio stays on this machine."""

    def serves(self, client_id: int) -> bool:
        """Whether a browser has opened a page of this server; others see no scene and no panels."""
        connection = self._websock_server._live_connections.get(ClientId(client_id))
        request = None if connection is None else connection.request
        return request is not None and is_own_page(request.headers)
