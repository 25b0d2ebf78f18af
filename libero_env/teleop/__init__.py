"""Recording demonstrations by hand: input devices, the recording session, screens."""
