"""The disk: how long logs are kept, and how much of them."""
