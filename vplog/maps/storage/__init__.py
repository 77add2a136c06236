"""Map folders on disks and object stores."""
