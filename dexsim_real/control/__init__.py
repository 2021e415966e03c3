"""The policy, its goals, and the safety limits."""
