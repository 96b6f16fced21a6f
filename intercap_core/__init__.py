"""Multi-camera RGB-D recordings of people handling objects, turned into a finished 4D dataset."""

from intercap_core.kernel_cache import use_kernel_cache

use_kernel_cache()  # before numba is imported
