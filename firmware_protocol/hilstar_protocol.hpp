/*
 * The wire between a simulator and hilstar, for C++17: hilstar_protocol.h in types that hold what they say. Needs that header
 * beside it and the standard library; no exceptions, no heap, no sockets.
 *
 *     hilstar::Attitude attitude;
 *     attitude.t_ns = clock_ns();
 *     attitude.q_icrs_to_cam = {0.5, 0.5, -0.5, 0.5};
 *     attitude.rate_cam_rad_s = {0.0F, 0.0F, 0.01F};     // left out where it is not known
 *     const auto packet = hilstar::encode(attitude);     // UDP, ZeroMQ: send packet.data(), packet.size()
 *     const auto frame = hilstar::frame(packet);         // serial line: write frame.data(), frame.size()
 *
 *     if (const auto request = hilstar::decode<hilstar::TimeRequest>(bytes, count)) ...      // a datagram
 *     if (const auto request = decoder.push<hilstar::TimeRequest>(byte)) ...                 // hilstar::Decoder decoder;
 */
#ifndef HILSTAR_PROTOCOL_HPP
#define HILSTAR_PROTOCOL_HPP

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <variant>

#include "hilstar_protocol.h"

namespace hilstar {

template <std::size_t Count>
using Bytes = std::array<std::uint8_t, Count>;

/** Why hilstar would refuse something, or why bytes are no packet. */
enum class Fault { format = HILSTAR_ERROR_FORMAT, crc = HILSTAR_ERROR_CRC, nan = HILSTAR_ERROR_NAN, norm = HILSTAR_ERROR_NORM };

/** Where the camera points at `t_ns`: a unit quaternion (w, x, y, z) that turns ICRS components into camera components. */
struct Attitude {
    static constexpr int kind = HILSTAR_KIND_ATTITUDE;
    std::int64_t t_ns = 0;
    std::array<double, 4> q_icrs_to_cam = {1.0, 0.0, 0.0, 0.0};
    /** Angular velocity of cam with respect to icrs, in cam components [rad/s]; none where it is not known. */
    std::optional<std::array<float, 3>> rate_cam_rad_s = std::nullopt;
    std::uint32_t sequence = 0;
    /** The attitude jumped since the previous packet. */
    bool discontinuity = false;
    /** The sender's number, 1 to HILSTAR_MAX_SENDER; 0: not given. */
    std::uint8_t sender = 0;
};

/** One side asks for the other's clock; `t1_ns` is the asker's just before the request leaves. */
struct TimeRequest {
    static constexpr int kind = HILSTAR_KIND_TIME_REQUEST;
    std::uint32_t sequence = 0;
    std::int64_t t1_ns = 0;
};

/** The answer: `t2_ns` when the request arrived, `t3_ns` just before the reply leaves, both on the answerer's clock. */
struct TimeReply {
    static constexpr int kind = HILSTAR_KIND_TIME_REPLY;
    std::uint32_t sequence = 0;
    std::int64_t t1_ns = 0, t2_ns = 0, t3_ns = 0;
};

/** What is on the screen, and hilstar's health: the sum of HILSTAR_HEALTH_ bits. */
struct Status {
    static constexpr int kind = HILSTAR_KIND_STATUS;
    std::uint16_t health = 0;
    std::uint32_t frame = 0;
    std::int64_t light_t_ns = 0, attitude_age_ns = 0;
    std::uint32_t attitude_sequence = 0, accepted = 0, refused = 0;

    bool is(unsigned bit) const { return (health & bit) != 0; }
};

/** What a star tracker found; `flags` is the sum of HILSTAR_ANSWER_ bits, and says whether attitude and rate are good. */
struct Answer {
    static constexpr int kind = HILSTAR_KIND_ANSWER;
    std::uint16_t flags = 0;
    std::uint32_t sequence = 0;
    std::int64_t t_ns = 0;
    std::array<double, 4> q_icrs_to_cam = {1.0, 0.0, 0.0, 0.0};
    std::array<float, 3> rate_cam_rad_s = {};
    std::uint32_t stars = 0;
};

namespace detail {

inline hilstar_attitude plain(const Attitude &in)
{
    hilstar_attitude out = {};
    out.flags = static_cast<std::uint16_t>((in.rate_cam_rad_s ? HILSTAR_FLAG_RATE_VALID : 0U) |
                                           (in.discontinuity ? HILSTAR_FLAG_DISCONTINUITY : 0U) |
                                           HILSTAR_SENDER_FLAGS(in.sender));
    out.sequence = in.sequence;
    out.t_ns = in.t_ns;
    for (std::size_t i = 0; i < 4; i++)
        out.q_icrs_to_cam[i] = in.q_icrs_to_cam[i];
    for (std::size_t i = 0; in.rate_cam_rad_s && i < 3; i++)
        out.rate_cam_rad_s[i] = (*in.rate_cam_rad_s)[i];
    return out;
}

inline int read(const std::uint8_t *packet, std::size_t length, Attitude &out)
{
    hilstar_attitude in = {};
    const int result = hilstar_decode_attitude(packet, length, &in);
    if (result < 0)
        return result;
    out.t_ns = in.t_ns;
    for (std::size_t i = 0; i < 4; i++)
        out.q_icrs_to_cam[i] = in.q_icrs_to_cam[i];
    out.rate_cam_rad_s.reset();
    if ((in.flags & HILSTAR_FLAG_RATE_VALID) != 0)
        out.rate_cam_rad_s = {in.rate_cam_rad_s[0], in.rate_cam_rad_s[1], in.rate_cam_rad_s[2]};
    out.sequence = in.sequence;
    out.discontinuity = (in.flags & HILSTAR_FLAG_DISCONTINUITY) != 0;
    const unsigned sender = HILSTAR_SENDER(in.flags);
    out.sender = static_cast<std::uint8_t>(sender <= HILSTAR_MAX_SENDER ? sender : 0U);
    return result;
}

inline int read(const std::uint8_t *packet, std::size_t length, TimeRequest &out)
{
    hilstar_time_request in = {};
    const int result = hilstar_decode_time_request(packet, length, &in);
    if (result > 0)
        out = {in.sequence, in.t1_ns};
    return result;
}

inline int read(const std::uint8_t *packet, std::size_t length, TimeReply &out)
{
    hilstar_time_reply in = {};
    const int result = hilstar_decode_time_reply(packet, length, &in);
    if (result > 0)
        out = {in.sequence, in.t1_ns, in.t2_ns, in.t3_ns};
    return result;
}

inline int read(const std::uint8_t *packet, std::size_t length, Status &out)
{
    hilstar_status in = {};
    const int result = hilstar_decode_status(packet, length, &in);
    if (result > 0)
        out = {in.health, in.frame, in.light_t_ns, in.attitude_age_ns, in.attitude_sequence, in.accepted, in.refused};
    return result;
}

inline int read(const std::uint8_t *packet, std::size_t length, Answer &out)
{
    hilstar_answer in = {};
    const int result = hilstar_decode_answer(packet, length, &in);
    if (result < 0)
        return result;
    out.flags = in.flags;
    out.sequence = in.sequence;
    out.t_ns = in.t_ns;
    for (std::size_t i = 0; i < 4; i++)
        out.q_icrs_to_cam[i] = in.q_icrs_to_cam[i];
    for (std::size_t i = 0; i < 3; i++)
        out.rate_cam_rad_s[i] = in.rate_cam_rad_s[i];
    out.stars = in.stars;
    return result;
}

} // namespace detail

/** Why hilstar would refuse this attitude; none where it would accept it. Ask before sending if you doubt your own numbers. */
inline std::optional<Fault> fault(const Attitude &attitude)
{
    const hilstar_attitude plain = detail::plain(attitude);
    const int result = hilstar_check_attitude(&plain);
    return result == 0 ? std::nullopt : std::optional<Fault>(static_cast<Fault>(result));
}

inline Bytes<HILSTAR_ATTITUDE_BYTES> encode(const Attitude &attitude)
{
    const hilstar_attitude plain = detail::plain(attitude);
    Bytes<HILSTAR_ATTITUDE_BYTES> packet = {};
    hilstar_encode_attitude(&plain, packet.data());
    return packet;
}

inline Bytes<HILSTAR_TIME_REQUEST_BYTES> encode(const TimeRequest &request)
{
    const hilstar_time_request plain = {request.sequence, request.t1_ns};
    Bytes<HILSTAR_TIME_REQUEST_BYTES> packet = {};
    hilstar_encode_time_request(&plain, packet.data());
    return packet;
}

inline Bytes<HILSTAR_TIME_REPLY_BYTES> encode(const TimeReply &reply)
{
    const hilstar_time_reply plain = {reply.sequence, reply.t1_ns, reply.t2_ns, reply.t3_ns};
    Bytes<HILSTAR_TIME_REPLY_BYTES> packet = {};
    hilstar_encode_time_reply(&plain, packet.data());
    return packet;
}

inline Bytes<HILSTAR_STATUS_BYTES> encode(const Status &status)
{
    const hilstar_status plain = {status.health,          status.frame,    status.light_t_ns, status.attitude_age_ns,
                                  status.attitude_sequence, status.accepted, status.refused};
    Bytes<HILSTAR_STATUS_BYTES> packet = {};
    hilstar_encode_status(&plain, packet.data());
    return packet;
}

inline Bytes<HILSTAR_ANSWER_BYTES> encode(const Answer &answer)
{
    hilstar_answer plain = {answer.flags, answer.sequence, answer.t_ns, {}, {}, answer.stars};
    for (std::size_t i = 0; i < 4; i++)
        plain.q_icrs_to_cam[i] = answer.q_icrs_to_cam[i];
    for (std::size_t i = 0; i < 3; i++)
        plain.rate_cam_rad_s[i] = answer.rate_cam_rad_s[i];
    Bytes<HILSTAR_ANSWER_BYTES> packet = {};
    hilstar_encode_answer(&plain, packet.data());
    return packet;
}

/** The packet of that kind, as UDP and ZeroMQ bring it; none where the bytes are anything else. */
template <typename Packet>
std::optional<Packet> decode(const std::uint8_t *bytes, std::size_t count)
{
    Packet found;
    return detail::read(bytes, count, found) == Packet::kind ? std::optional<Packet>(found) : std::nullopt;
}

/** Any packet, or why the bytes are none. */
using Event = std::variant<Fault, Attitude, TimeRequest, TimeReply, Status, Answer>;

inline Event decode(const std::uint8_t *bytes, std::size_t count)
{
    const int kind = hilstar_check(bytes, count);
    switch (kind) {
    case HILSTAR_KIND_ATTITUDE: return *decode<Attitude>(bytes, count);
    case HILSTAR_KIND_TIME_REQUEST: return *decode<TimeRequest>(bytes, count);
    case HILSTAR_KIND_TIME_REPLY: return *decode<TimeReply>(bytes, count);
    case HILSTAR_KIND_STATUS: return *decode<Status>(bytes, count);
    case HILSTAR_KIND_ANSWER: return *decode<Answer>(bytes, count);
    default: return static_cast<Fault>(kind);
    }
}

/** A packet as it goes over a serial line: COBS, then 0x00, which is always two bytes more. */
template <std::size_t Count>
Bytes<Count + 2> frame(const Bytes<Count> &packet)
{
    static_assert(Count <= HILSTAR_LONGEST_PACKET, "longer than any packet");
    Bytes<Count + 2> framed = {};
    hilstar_frame(packet.data(), Count, framed.data());
    return framed;
}

/** Bytes of a serial line in, packets out. After any garbage, the next whole frame that follows a 0x00 is decoded. */
class Decoder {
public:
    /** The packet or the fault that this byte completes; none where it completes nothing. */
    std::optional<Event> push(std::uint8_t byte)
    {
        const int result = hilstar_push(&decoder_, byte);
        if (result == 0)
            return std::nullopt;
        return result < 0 ? Event(static_cast<Fault>(result)) : decode(decoder_.packet, decoder_.length);
    }

    /** The packet of that kind that this byte completes; any other is only counted. */
    template <typename Packet>
    std::optional<Packet> push(std::uint8_t byte)
    {
        return hilstar_push(&decoder_, byte) == Packet::kind ? decode<Packet>(decoder_.packet, decoder_.length) : std::nullopt;
    }

    std::uint32_t accepted() const { return decoder_.accepted; }
    std::uint32_t refused() const { return decoder_.refused_crc + decoder_.refused_format; }

private:
    hilstar_decoder decoder_ = {};
};

} // namespace hilstar

#endif
