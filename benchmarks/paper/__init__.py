"""The paper's tables and figures: what they consist of, how a row is measured, and how it is shown."""
