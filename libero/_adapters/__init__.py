"""Parts of the facade that are not paths of the original."""
