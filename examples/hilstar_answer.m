function packet = hilstar_answer(sequence, t_ns, q_icrs_to_cam, rate_cam_rad_s, flags, stars)
% HILSTAR_ANSWER  The 68 bytes of a star tracker's answer, for a UDP datagram to hilstar: a row of uint8. MATLAB and Octave.
%
%   sequence         answers sent so far
%   t_ns             the tracker's clock at the middle of the exposure, ns; int64
%   q_icrs_to_cam    unit quaternion [w x y z], scalar first: turns ICRS components into camera components
%   rate_cam_rad_s   angular velocity of the camera [x y z], rad/s, in camera components; [] where it is not known
%   flags            sum of 2 valid, 4 lost in space, 8 tracking, 16 too few stars, 32 blinded
%   stars            how many stars the attitude was found by

has_rate = ~isempty(rate_cam_rad_s);
if ~has_rate
    rate_cam_rad_s = [0 0 0];
end
body = [uint8([1 5]), bytes_of(uint16(flags) + uint16(has_rate)), bytes_of(uint32(sequence)), bytes_of(int64(t_ns)), ...
        bytes_of(double(q_icrs_to_cam(1:4))), bytes_of(single(rate_cam_rad_s(1:3))), bytes_of(uint32(stars))];
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
