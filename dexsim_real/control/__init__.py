"""Control of the hand: policy, goals, safety limits, and the exchange thread."""
