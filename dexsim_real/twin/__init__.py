"""The emulated hand: physics that no policy has trained on, behind the real hand's bytes."""
