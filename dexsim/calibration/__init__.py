"""Motor current to joint torque, taxel counts to newtons."""
