"""Recurrent state between requests: sessions, streams, and state carried by the client."""
