"""Clients of a policy server over HTTP and WebSocket. They import no runtime and no server code."""
