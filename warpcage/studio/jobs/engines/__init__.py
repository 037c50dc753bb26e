"""What runs chunks of items: threads, processes of this machine, Ray."""
