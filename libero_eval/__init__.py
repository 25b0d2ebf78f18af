"""Judge any policy: protocols, policy servers, resumable evaluations, comparisons, robustness."""
