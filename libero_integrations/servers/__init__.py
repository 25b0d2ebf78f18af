"""Clients of the policy servers of vla-eval and of GR00T, for `libero eval vla-eval://...` and `libero eval gr00t://...`."""
