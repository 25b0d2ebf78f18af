"""Why a run forgets: what moved in its policy, and what brings an old task back."""
