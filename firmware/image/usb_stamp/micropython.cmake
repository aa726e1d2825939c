# The box's one module in C; usb_stamp.c says what for.
add_library(usermod_usb_stamp INTERFACE)
target_sources(usermod_usb_stamp INTERFACE ${CMAKE_CURRENT_LIST_DIR}/usb_stamp.c)
target_link_libraries(usermod INTERFACE usermod_usb_stamp)

# MicroPython 1.26 has a hook of that name itself: it gets another name, and usb_stamp.c calls it.
set(MP_USBD ${MICROPY_DIR}/shared/tinyusb/mp_usbd.c)
file(STRINGS ${MP_USBD} own_hook REGEX "void tud_event_hook_cb")
if(own_hook)
    set_source_files_properties(${MP_USBD} PROPERTIES COMPILE_DEFINITIONS "tud_event_hook_cb=micropython_event_hook")
    set_source_files_properties(${CMAKE_CURRENT_LIST_DIR}/usb_stamp.c PROPERTIES COMPILE_DEFINITIONS "MICROPYTHON_EVENT_HOOK=micropython_event_hook")
endif()

# A component of Pico SDK 2.2 that MicroPython 1.26 does not name: its headers are wanted where names are gathered (NO_QSTR).
set(PLATFORM_COMMON ${PICO_SDK_PATH}/src/rp2_common/pico_platform_common/include)
if(EXISTS ${PLATFORM_COMMON})
    target_include_directories(usermod_usb_stamp INTERFACE ${PLATFORM_COMMON})
endif()
