"""Touch: the skin's law, what taxels feel, force and centre per finger."""
