"""Success against the severity of perturbations."""
