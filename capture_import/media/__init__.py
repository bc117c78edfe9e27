"""Images, videos, depth images and archives: reading, turning, blurring and writing them."""
