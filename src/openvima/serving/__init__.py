"""Policies behind a WebSocket: a server for any policy, and the client that scores remote ones."""

from openvima.serving.client import RemotePolicy
from openvima.serving.protocol import PROTOCOL
from openvima.serving.server import serve, serve_in_thread

__all__ = ["PROTOCOL", "RemotePolicy", "serve", "serve_in_thread"]
