"""One joint's drive: torque, gear play, motor current."""
