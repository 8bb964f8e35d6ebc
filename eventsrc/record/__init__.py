"""What fills a log: recorder, importers, the robot's side, Zenoh."""
