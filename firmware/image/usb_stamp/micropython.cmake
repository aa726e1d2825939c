# The box's one module in C; usb_stamp.c says what for.
add_library(usermod_usb_stamp INTERFACE)
target_sources(usermod_usb_stamp INTERFACE ${CMAKE_CURRENT_LIST_DIR}/usb_stamp.c)
target_link_libraries(usermod INTERFACE usermod_usb_stamp)
