#define MICROPY_HW_BOARD_NAME "truearm box (Raspberry Pi Pico)"
#define MICROPY_HW_FLASH_STORAGE_BYTES (1408 * 1024) // as the Pico's own: a box keeps its files whichever image it gets
#define MICROPY_HW_USB_MANUFACTURER_STRING "truearm"
#define MICROPY_HW_USB_PRODUCT_FS_STRING "truearm box"
#define MICROPY_OPT_MAP_LOOKUP_CACHE_SIZE (1024) // of attributes, which the streaming loop looks up all the time; the usual 128 are too few for it
