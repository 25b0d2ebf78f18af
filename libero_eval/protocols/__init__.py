"""How a policy is evaluated: what it sees, what its actions mean, from which initial states, and for how long."""
