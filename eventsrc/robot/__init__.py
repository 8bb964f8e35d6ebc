"""What runs on the robot: envelopes are published, and kept until a recorder acknowledges them."""
