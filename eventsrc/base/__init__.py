"""What every part uses: errors, text for people, the clock, progress, checksums, processes."""
