"""The hand's wire format and its serial port: frames, link, driver."""
