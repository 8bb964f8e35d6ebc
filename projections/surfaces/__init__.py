"""What people and programs use: commands, Python, HTTP and Zenoh, the web page, the demo."""
