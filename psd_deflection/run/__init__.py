"""What happens while it runs? Threads, bounded queues and shutdown; many recordings; the live page."""
