"""Parts of the facade that are no paths of the original."""
