/*
 * firmware_protocol/hilstar_protocol.hpp, driven by lines on stdin; tests/unit/attitude/wire/test_cpp_header.py writes them.
 *
 *     d HEX    decode a message ("-" is none), and encode it again  ->  kind packet frame [fault]  |  error
 *     i        a new streaming decoder                              ->  ready
 *     p HEX    push bytes into it                                   ->  [kind:packet | error]... . accepted refused
 */
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <string>
#include <vector>

#include "hilstar_protocol.hpp"

namespace {

std::vector<std::uint8_t> bytes_of(const std::string &hex)
{
    std::vector<std::uint8_t> bytes;
    for (std::size_t i = 0; hex != "-" && i + 1 < hex.size(); i += 2)
        bytes.push_back(static_cast<std::uint8_t>(std::strtoul(hex.substr(i, 2).c_str(), nullptr, 16)));
    return bytes;
}

template <std::size_t Count>
void print(const hilstar::Bytes<Count> &bytes)
{
    for (const std::uint8_t byte : bytes)
        std::printf("%02x", byte);
}

struct Whole {
    void operator()(hilstar::Fault fault) const { std::printf("%d", static_cast<int>(fault)); }

    template <typename Packet>
    void operator()(const Packet &packet) const
    {
        std::printf("%d ", Packet::kind);
        print(hilstar::encode(packet));
        std::printf(" ");
        print(hilstar::frame(hilstar::encode(packet)));
        if constexpr (Packet::kind == HILSTAR_KIND_ATTITUDE)
            if (const auto fault = hilstar::fault(packet))
                std::printf(" %d", static_cast<int>(*fault));
    }
};

struct Short {
    void operator()(hilstar::Fault fault) const { std::printf("%d ", static_cast<int>(fault)); }

    template <typename Packet>
    void operator()(const Packet &packet) const
    {
        std::printf("%d:", Packet::kind);
        print(hilstar::encode(packet));
        std::printf(" ");
    }
};

} // namespace

int main()
{
    hilstar::Decoder decoder;
    static char text[1 << 16];
    while (std::fgets(text, sizeof text, stdin) != nullptr) {
        const std::string line(text, std::strcspn(text, "\n"));
        const std::vector<std::uint8_t> bytes = bytes_of(line.size() > 2 ? line.substr(2) : "");
        if (line[0] == 'd') {
            std::visit(Whole{}, hilstar::decode(bytes.data(), bytes.size()));
        } else if (line[0] == 'i') {
            decoder = hilstar::Decoder();
            std::printf("ready");
        } else {
            for (const std::uint8_t byte : bytes)
                if (const auto event = decoder.push(byte))
                    std::visit(Short{}, *event);
            std::printf(". %u %u", decoder.accepted(), decoder.refused());
        }
        std::printf("\n");
    }
    return 0;
}
