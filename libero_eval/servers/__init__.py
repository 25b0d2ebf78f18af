"""Policy servers: openpi's protocol as a client and as a server, and what all clients share."""
