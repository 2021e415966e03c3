"""From bytes and pictures to `Readings`."""
