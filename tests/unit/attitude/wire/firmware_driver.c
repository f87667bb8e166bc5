/*
 * firmware_protocol/hilstar_protocol.h, driven by lines on stdin; tests/unit/test_firmware.py writes them.
 *
 *     e KIND BITS...   encode: each number as the hex of its bits  ->  packet frame
 *     d HEX            decode a packet ("-" is none)               ->  result [check BITS...]
 *     i                a new streaming decoder                     ->  ready
 *     p HEX            push bytes into it                          ->  [KIND:PACKET | ERROR]... . accepted crc format
 *
 * Every buffer is as long as it has to be and no longer, so that a sanitizer sees each byte read or written too far.
 */
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>

#include "hilstar_protocol.h"

#define MOST_BYTES 65536

static char line[2 * MOST_BYTES + 64];
static hilstar_decoder decoder;

static void fail(const char *why)
{
    fprintf(stderr, "%s: %s", why, line);
    exit(1);
}

static uint8_t *room(size_t length)
{
    uint8_t *bytes = (uint8_t *)malloc(length ? length : 1);
    if (!bytes)
        fail("no memory");
    return bytes;
}

static void print_hex(const uint8_t *bytes, size_t length)
{
    size_t i;
    for (i = 0; i < length; i++)
        printf("%02x", bytes[i]);
}

static uint8_t *parse_hex(const char *text, size_t *length)
{
    uint8_t *bytes;
    size_t i;
    *length = strspn(text, "0123456789abcdef") / 2;
    bytes = room(*length);
    for (i = 0; i < *length; i++) {
        char pair[3] = {text[2 * i], text[2 * i + 1], 0};
        bytes[i] = (uint8_t)strtoul(pair, NULL, 16);
    }
    return bytes;
}

static uint64_t next_bits(char **text)
{
    return strtoull(*text, text, 16);
}

static size_t encode_attitude(char *text, uint8_t *out)
{
    hilstar_attitude in;
    size_t i;
    in.flags = (uint16_t)next_bits(&text);
    in.sequence = (uint32_t)next_bits(&text);
    in.t_ns = hilstar_i64_of(next_bits(&text));
    for (i = 0; i < 4; i++)
        in.q_icrs_to_cam[i] = hilstar_f64_of(next_bits(&text));
    for (i = 0; i < 3; i++) {
        const uint32_t bits = (uint32_t)next_bits(&text);
        memcpy(&in.rate_cam_rad_s[i], &bits, sizeof bits);
    }
    return hilstar_encode_attitude(&in, out);
}

static size_t encode_time_request(char *text, uint8_t *out)
{
    hilstar_time_request in;
    in.sequence = (uint32_t)next_bits(&text);
    in.t1_ns = hilstar_i64_of(next_bits(&text));
    return hilstar_encode_time_request(&in, out);
}

static size_t encode_time_reply(char *text, uint8_t *out)
{
    hilstar_time_reply in;
    in.sequence = (uint32_t)next_bits(&text);
    in.t1_ns = hilstar_i64_of(next_bits(&text));
    in.t2_ns = hilstar_i64_of(next_bits(&text));
    in.t3_ns = hilstar_i64_of(next_bits(&text));
    return hilstar_encode_time_reply(&in, out);
}

static size_t encode_status(char *text, uint8_t *out)
{
    hilstar_status in;
    in.health = (uint16_t)next_bits(&text);
    in.frame = (uint32_t)next_bits(&text);
    in.light_t_ns = hilstar_i64_of(next_bits(&text));
    in.attitude_age_ns = hilstar_i64_of(next_bits(&text));
    in.attitude_sequence = (uint32_t)next_bits(&text);
    in.accepted = (uint32_t)next_bits(&text);
    in.refused = (uint32_t)next_bits(&text);
    return hilstar_encode_status(&in, out);
}

static size_t encode_answer(char *text, uint8_t *out)
{
    hilstar_answer in;
    size_t i;
    in.flags = (uint16_t)next_bits(&text);
    in.sequence = (uint32_t)next_bits(&text);
    in.t_ns = hilstar_i64_of(next_bits(&text));
    for (i = 0; i < 4; i++)
        in.q_icrs_to_cam[i] = hilstar_f64_of(next_bits(&text));
    for (i = 0; i < 3; i++) {
        const uint32_t bits = (uint32_t)next_bits(&text);
        memcpy(&in.rate_cam_rad_s[i], &bits, sizeof bits);
    }
    in.stars = (uint32_t)next_bits(&text);
    return hilstar_encode_answer(&in, out);
}

static void encode(char *text)
{
    const int kind = (int)strtol(text, &text, 10);
    const size_t length = hilstar_packet_bytes(kind);
    uint8_t *packet = room(length), *frame = room(length + 2);
    size_t written = 0;
    switch (kind) {
    case HILSTAR_KIND_ATTITUDE: written = encode_attitude(text, packet); break;
    case HILSTAR_KIND_TIME_REQUEST: written = encode_time_request(text, packet); break;
    case HILSTAR_KIND_TIME_REPLY: written = encode_time_reply(text, packet); break;
    case HILSTAR_KIND_STATUS: written = encode_status(text, packet); break;
    case HILSTAR_KIND_ANSWER: written = encode_answer(text, packet); break;
    default: fail("no such kind");
    }
    if (written != length || hilstar_frame(packet, length, frame) != length + 2)
        fail("a wrong length");
    print_hex(packet, length);
    putchar(' ');
    print_hex(frame, length + 2);
    free(packet);
    free(frame);
}

static void print_bits(uint64_t bits)
{
    printf(" %" PRIx64, bits);
}

static void print_attitude(const hilstar_attitude *attitude)
{
    size_t i;
    printf(" %d", hilstar_check_attitude(attitude));
    print_bits(attitude->flags);
    print_bits(attitude->sequence);
    print_bits((uint64_t)attitude->t_ns);
    for (i = 0; i < 4; i++)
        print_bits(hilstar_bits_of_f64(attitude->q_icrs_to_cam[i]));
    for (i = 0; i < 3; i++) {
        uint32_t bits;
        memcpy(&bits, &attitude->rate_cam_rad_s[i], sizeof bits);
        print_bits(bits);
    }
}

static void print_status(const hilstar_status *status)
{
    printf(" 0");
    print_bits(status->health);
    print_bits(status->frame);
    print_bits((uint64_t)status->light_t_ns);
    print_bits((uint64_t)status->attitude_age_ns);
    print_bits(status->attitude_sequence);
    print_bits(status->accepted);
    print_bits(status->refused);
}

static void print_answer(const hilstar_answer *answer)
{
    size_t i;
    printf(" 0");
    print_bits(answer->flags);
    print_bits(answer->sequence);
    print_bits((uint64_t)answer->t_ns);
    for (i = 0; i < 4; i++)
        print_bits(hilstar_bits_of_f64(answer->q_icrs_to_cam[i]));
    for (i = 0; i < 3; i++) {
        uint32_t bits;
        memcpy(&bits, &answer->rate_cam_rad_s[i], sizeof bits);
        print_bits(bits);
    }
    print_bits(answer->stars);
}

static void decode(const char *text)
{
    size_t length;
    uint8_t *packet = parse_hex(text, &length);
    static hilstar_attitude attitude;
    static hilstar_time_request request;
    static hilstar_time_reply reply;
    static hilstar_status status;
    static hilstar_answer answer;
    const int result = hilstar_check(packet, length);
    /* Each takes its own kind and no other. */
    const int as_attitude = hilstar_decode_attitude(packet, length, &attitude);
    const int as_request = hilstar_decode_time_request(packet, length, &request);
    const int as_reply = hilstar_decode_time_reply(packet, length, &reply);
    const int as_status = hilstar_decode_status(packet, length, &status);
    const int as_answer = hilstar_decode_answer(packet, length, &answer);
    const int taken = (as_attitude > 0) + (as_request > 0) + (as_reply > 0) + (as_status > 0) + (as_answer > 0);
    if (taken != (result > 0))
        fail("taken for another kind, or for none");
    printf("%d", result);
    if (as_attitude == HILSTAR_KIND_ATTITUDE)
        print_attitude(&attitude);
    if (as_request == HILSTAR_KIND_TIME_REQUEST) {
        printf(" 0 %" PRIx32, request.sequence);
        print_bits((uint64_t)request.t1_ns);
    }
    if (as_reply == HILSTAR_KIND_TIME_REPLY) {
        printf(" 0 %" PRIx32, reply.sequence);
        print_bits((uint64_t)reply.t1_ns);
        print_bits((uint64_t)reply.t2_ns);
        print_bits((uint64_t)reply.t3_ns);
    }
    if (as_status == HILSTAR_KIND_STATUS)
        print_status(&status);
    if (as_answer == HILSTAR_KIND_ANSWER)
        print_answer(&answer);
    free(packet);
}

static void push(const char *text)
{
    size_t length, i;
    uint8_t *bytes = parse_hex(text, &length);
    for (i = 0; i < length; i++) {
        const int event = hilstar_push(&decoder, bytes[i]);
        if (event > 0) {
            printf("%d:", event);
            print_hex(decoder.packet, decoder.length);
            putchar(' ');
        } else if (event < 0) {
            printf("%d ", event);
        }
    }
    printf(". %" PRIu32 " %" PRIu32 " %" PRIu32, decoder.accepted, decoder.refused_crc, decoder.refused_format);
    free(bytes);
}

int main(void)
{
    hilstar_decoder_init(&decoder);
    while (fgets(line, sizeof line, stdin)) {
        switch (line[0]) {
        case 'e': encode(line + 1); break;
        case 'd': decode(line + 2); break;
        case 'i': hilstar_decoder_init(&decoder); printf("ready"); break;
        case 'p': push(line + 2); break;
        default: fail("no such command");
        }
        putchar('\n');
    }
    return 0;
}
