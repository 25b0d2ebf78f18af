"""Learning from reward: episodes of the policy itself in place of demonstrations."""
