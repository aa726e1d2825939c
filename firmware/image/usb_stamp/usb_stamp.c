// The two times of a clock exchange (protocol/SPEC.md, sync-reply), closer to the wire than Python can take them.
//
//     receive(buf, stamp)         read what has come, at most len(buf) bytes, with the device time at which the newest packet was there
//     send(buf, at, end, place)   finish a frame with the device time at which it goes, and send it
//
// t1 is taken in the USB interrupt. Whatever Python reads came in that packet or in an earlier one, so no request's t1 is before its arrival.
// t2 is taken when the endpoint is free and nothing but CRC, COBS and the FIFO stands between it and the wire.
// Nothing here allocates.

#include "py/mphal.h"
#include "py/runtime.h"
#include "py/stream.h"

#ifndef NO_QSTR
#include "hardware/structs/usb_dpram.h"
#include "hardware/sync.h"
#include "hardware/timer.h"
#include "device/dcd.h"
#include "device/usbd_pvt.h"
#include "tusb.h"
#endif
#include "mp_usbd.h"
#include "mp_usbd_cdc.h"

#define OUT_ENDPOINT (USBD_CDC_EP_OUT & 0x7f)
#define HEAD (2) // delimiter and first code byte, before the payload
#define TAIL (5) // CRC and delimiter, behind it
#define PAYLOAD_MAX (250)
#define TIME_BYTES (8)

static volatile uint64_t newest_us; // 0: no packet yet

// TinyUSB calls this in the USB interrupt, behind each event. A packet from the host that the stack has not taken yet keeps its buffer marked
// full, so an event of another endpoint may stamp it again, later: that is true, and costs only the time in between.
void tud_event_hook_cb(uint8_t rhport, uint32_t event, bool in_isr) {
    (void)rhport;
    if (in_isr && event == DCD_EVENT_XFER_COMPLETE && (usb_dpram->ep_buf_ctrl[OUT_ENDPOINT].out & USB_BUF_CTRL_FULL)) {
        newest_us = time_us_64();
    }
    #ifdef MICROPYTHON_EVENT_HOOK // from 1.26 on (micropython.cmake)
    extern void MICROPYTHON_EVENT_HOOK(uint8_t rhport, uint32_t event, bool in_isr);
    MICROPYTHON_EVENT_HOOK(rhport, event, in_isr);
    #endif
}

static void put_time(uint8_t *out, uint64_t us) {
    for (int i = TIME_BYTES - 1; i >= 0; --i) {
        out[i] = us & 0xff;
        us >>= 8;
    }
}

static mp_obj_t receive(mp_obj_t buf, mp_obj_t stamp) {
    mp_buffer_info_t in, time;
    mp_get_buffer_raise(buf, &in, MP_BUFFER_WRITE);
    mp_get_buffer_raise(stamp, &time, MP_BUFFER_WRITE);
    if (time.len < TIME_BYTES) {
        mp_raise_ValueError(NULL);
    }
    size_t n = 0;
    while (n < in.len && (mp_hal_stdio_poll(MP_STREAM_POLL_RD) & MP_STREAM_POLL_RD)) {
        ((uint8_t *)in.buf)[n++] = mp_hal_stdin_rx_chr();
    }
    if (n) {
        uint32_t state = save_and_disable_interrupts();
        uint64_t us = newest_us;
        restore_interrupts(state);
        put_time(time.buf, us ? us : time_us_64());
    }
    return MP_OBJ_NEW_SMALL_INT(n);
}
static MP_DEFINE_CONST_FUN_OBJ_2(receive_obj, receive);

// CRC-32 by half bytes, of the reflected polynomial 0xEDB88320
static uint32_t crc32(const uint8_t *at, const uint8_t *end) {
    static const uint32_t table[16] = {
        0x00000000, 0x1DB71064, 0x3B6E20C8, 0x26D930AC, 0x76DC4190, 0x6B6B51F4, 0x4DB26158, 0x5005713C,
        0xEDB88320, 0xF00F9344, 0xD6D6A3E8, 0xCB61B38C, 0x9B64C2B0, 0x86D3D2D4, 0xA00AE278, 0xBDBDF21C,
    };
    uint32_t crc = 0xffffffff;
    while (at < end) {
        crc ^= *at++;
        crc = crc >> 4 ^ table[crc & 15];
        crc = crc >> 4 ^ table[crc & 15];
    }
    return ~crc;
}

// As truearm_wire.frame.close: the payload is buf[HEAD:end]. Returns the frame's length.
static size_t close_frame(uint8_t *buf, size_t end) {
    uint32_t crc = crc32(buf + HEAD, buf + end);
    for (int i = 0; i < 4; ++i) {
        buf[end + i] = crc >> 8 * i & 0xff;
    }
    size_t code_at = HEAD - 1;
    for (size_t i = HEAD; i < end + 4; ++i) {
        if (buf[i] == 0) {
            buf[code_at] = i - code_at;
            code_at = i;
        }
    }
    buf[code_at] = end + 4 - code_at;
    buf[0] = 0;
    buf[end + 4] = 0;
    return end + TAIL;
}

// Against erratum E15 TinyUSB begins no transfer to the host from 800 to 998 us after a start of frame, but at the next one. A frame stamped
// then, or so late before that CRC and FIFO last until then, would wait behind its stamp.
static bool held_back(void) {
    #if PICO_RP2040_USB_DEVICE_UFRAME_FIX
    extern volatile uint32_t e15_last_sof;
    uint32_t since_us = time_us_32() - e15_last_sof;
    return since_us > 750 && since_us <= 998;
    #else
    return false;
    #endif
}

// The payload buf[at + HEAD:end] gets the time at buf[place:place + 8] and goes. Returns the length of the frame, or 0 if the host has not
// fetched all that was sent before, or the transfer would wait; then nothing was changed.
static mp_obj_t send(size_t n_args, const mp_obj_t *args) {
    (void)n_args;
    mp_buffer_info_t buffer;
    mp_get_buffer_raise(args[0], &buffer, MP_BUFFER_WRITE);
    size_t at = mp_obj_get_int(args[1]), end = mp_obj_get_int(args[2]), place = mp_obj_get_int(args[3]);
    if (at > buffer.len || end > buffer.len || end + TAIL > buffer.len || end > at + HEAD + PAYLOAD_MAX
        || place < at + HEAD || place + TIME_BYTES > end) {
        mp_raise_ValueError(NULL);
    }
    mp_usbd_task();
    if (tud_cdc_write_available() < CFG_TUD_CDC_TX_BUFSIZE || usbd_edpt_busy(0, USBD_CDC_EP_IN) || held_back()) {
        return MP_OBJ_NEW_SMALL_INT(0);
    }
    uint8_t *frame = (uint8_t *)buffer.buf + at;
    put_time(frame + place - at, time_us_64());
    return MP_OBJ_NEW_SMALL_INT(mp_usbd_cdc_tx_strn((const char *)frame, close_frame(frame, end - at)));
}
static MP_DEFINE_CONST_FUN_OBJ_VAR_BETWEEN(send_obj, 4, 4, send);

static const mp_rom_map_elem_t globals_table[] = {
    { MP_ROM_QSTR(MP_QSTR___name__), MP_ROM_QSTR(MP_QSTR_usb_stamp) },
    { MP_ROM_QSTR(MP_QSTR_receive), MP_ROM_PTR(&receive_obj) },
    { MP_ROM_QSTR(MP_QSTR_send), MP_ROM_PTR(&send_obj) },
};
static MP_DEFINE_CONST_DICT(globals, globals_table);

const mp_obj_module_t usb_stamp_module = {
    .base = { &mp_type_module },
    .globals = (mp_obj_dict_t *)&globals,
};
MP_REGISTER_MODULE(MP_QSTR_usb_stamp, usb_stamp_module);
