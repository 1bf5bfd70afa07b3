"""What a camera looks at: moving layers, videos, a camera's own frames, random scenes."""
