"""What runs on the robot: publish envelopes, keep them until a recorder has acknowledged them."""
