"""Policy servers: the protocols of openpi, vla-eval and GR00T as a client, and openpi's as a server."""
