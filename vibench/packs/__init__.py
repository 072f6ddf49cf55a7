"""Model packs: folders of matrices from any code; their format, what they hold, its checks, and writing them."""
