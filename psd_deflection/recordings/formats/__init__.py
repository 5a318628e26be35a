"""The formats of recordings: one declaration each."""
