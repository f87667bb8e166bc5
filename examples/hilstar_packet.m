function packet = hilstar_packet(sequence, t_ns, q_icrs_to_cam, rate_cam_rad_s, discontinuity)
% HILSTAR_PACKET  The 64 bytes of an attitude, for a UDP datagram to hilstar: a row of uint8. MATLAB and Octave.
%
%   sequence         packets sent so far
%   t_ns             the simulation's clock at this attitude, ns; int64, since a double is exact to 2^53 ns (104 days) only
%   q_icrs_to_cam    unit quaternion [w x y z], scalar first: turns ICRS components into camera components
%   rate_cam_rad_s   angular velocity of the camera [x y z], rad/s, in camera components; [] where it is not known
%   discontinuity    true where the attitude jumped since the previous packet
%
% Where quat2dcm(q) of the Aerospace Toolbox turns ICRS components into camera components, send [q(1) -q(2:4)]; compare with
% the three attitudes that firmware_protocol/README.md lists. In Simulink, call this from a MATLAB Function block and send its
% output by a UDP Send block.

if nargin < 5
    discontinuity = false;
end
has_rate = ~isempty(rate_cam_rad_s);
if ~has_rate
    rate_cam_rad_s = [0 0 0];
end
flags = uint16(has_rate) + 2 * uint16(discontinuity);
body = [uint8([1 1]), bytes_of(flags), bytes_of(uint32(sequence)), bytes_of(int64(t_ns)), ...
        bytes_of(double(q_icrs_to_cam(1:4))), bytes_of(single(rate_cam_rad_s(1:3)))];
packet = [body, bytes_of(crc32(body))];
end

function bytes = bytes_of(numbers)
% Little-endian, whatever the machine is.
[~, ~, order] = computer();
if order == 'B'
    numbers = swapbytes(numbers);
end
bytes = typecast(numbers(:).', 'uint8');
end

function crc = crc32(bytes)
% IEEE 802.3, as zlib's.
persistent table
if isempty(table)
    table = zeros(1, 256, 'uint32');
    for k = 0:255
        entry = uint32(k);
        for bit = 1:8
            odd = bitand(entry, uint32(1));
            entry = bitshift(entry, -1);
            if odd
                entry = bitxor(entry, uint32(3988292384));
            end
        end
        table(k + 1) = entry;
    end
end
crc = uint32(4294967295);
for byte = uint32(bytes)
    crc = bitxor(bitshift(crc, -8), table(double(bitand(bitxor(crc, byte), uint32(255))) + 1));
end
crc = bitxor(crc, uint32(4294967295));
end
