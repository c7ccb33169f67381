"""What the machine needs: XLA settings, programs kept on disk, files, progress bars."""
